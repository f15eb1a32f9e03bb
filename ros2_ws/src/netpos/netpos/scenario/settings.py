"""Tracker parameters that come with the input: of a scenario, or of a bag that carries them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from netpos.bags.errors import BagError
from netpos.common.yaml_text import YamlError, dump_yaml, load_yaml
from netpos.messages import topics
from netpos.messages.values import RsuInfo
from netpos.tracking.config import TrackerConfig
from netpos.tracking.networks.config import FusionConfig

if TYPE_CHECKING:
    from netpos.bags import BagReader

# Name of the fact with the parameters of the tracker, as YAML.
TRACKER_FACT = "tracker"
# Name of the facts with parameters that changed while the bag was recorded, as YAML.
CHANGE_FACT = "tracker_change"
# Name of the fact with the list of RSUs of the tracker, as YAML.
RSUS_FACT = "rsus"
# Name of the fact with the scenario and its seed, for simulated runs, as YAML.
SCENARIO_FACT = "scenario"
# Name of the fact with the fused networks and the parameters of the fusion.
FUSION_FACT = "fusion"


# Parameters of earlier versions, and the value at which a tracker did what it does now.
_REMOVED = {"backend": "compiled", "sector_probability": 0.999}


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Parameters by name, and the devices to expect.

    ``networks``: each has a tracker of its own, and their tracks are fused with the parameters
    ``fusion``; none: one tracker for all RSUs.
    """

    parameters: Mapping[str, Any] = field(default_factory=dict)
    vue_ids: tuple[str, ...] = ("vue_1",)
    networks: tuple[str, ...] = ()
    fusion: Mapping[str, Any] = field(default_factory=dict)
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names that each network gives the devices, where they differ."""
    rsus: str = ""
    """The network's list of RSUs as YAML; empty: none."""

    @property
    def rsu_list(self) -> list[RsuInfo]:
        """The RSUs of the list. Raises ``ValueError`` for one that cannot be understood."""
        if not self.rsus:
            return []
        from netpos.bags.importers.own.rsus import rsus_of_text  # noqa: PLC0415 - no file, no reader

        return rsus_of_text(self.rsus, "the list of RSUs")

    def names_by(self, network: str) -> tuple[str, ...]:
        """What a network calls the devices to expect."""
        return self.names.get(network, self.vue_ids)


DEFAULTS = TrackerSettings()


def bag_settings(bag: BagReader) -> TrackerSettings:
    """Settings in a bag: those that its trackers published, or that its writer noted.

    Raises ``BagError`` where it holds none, or several that do not agree.
    """
    fusion = _mapping(bag, FUSION_FACT)
    if fusion is None and TRACKER_FACT not in bag.facts:
        raise BagError(f"{bag.path} does not say with which parameters to track it")
    networks = tuple(map(str, (fusion or {}).pop("networks", ())))
    parameters = known_parameters(_mapping(bag, TRACKER_FACT) or {})
    lists = bag.facts.get(RSUS_FACT, ())
    if len(lists) > 1:
        raise BagError(f"{bag.path} was tracked with {len(lists)} different lists of RSUs")
    rsus = lists[0] if lists else ""
    return TrackerSettings(parameters, networks=networks, fusion=fusion or {}, rsus=rsus)


def known_parameters(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that a bag tells, without those of an earlier version that say what every
    tracker does now."""
    gone = {name for name, value in _REMOVED.items() if recorded.get(name) == value}
    return {name: value for name, value in recorded.items() if name not in gone}


def tracker_fact(config: TrackerConfig, rsus: str = "") -> dict[str, str]:
    """Facts of a bag: every parameter of its tracker, and its list of RSUs; trackers of several
    networks have the same facts."""
    facts = {TRACKER_FACT: dump_yaml(asdict(replace(config, network="")))}
    return facts | ({RSUS_FACT: rsus} if rsus else {})


def change_fact(stamp_ns: int, values: Mapping[str, Any]) -> dict[str, str]:
    """What a bag is told of parameters that changed while its tracker ran, after the estimate of
    ``stamp_ns``."""
    return {CHANGE_FACT: dump_yaml({"stamp_ns": stamp_ns, **values})}


def list_of(file: Path | str, datum: str = "") -> str:
    """The RSUs of a file as the text of a list, every digit kept; empty for no file. ``datum``:
    of a file that gives latitudes and longitudes and no datum of its own.

    Raises ``BagError`` for a file that cannot be understood.
    """
    if not file:
        return ""
    from netpos.bags.importers.own.rsus import read_rsus  # noqa: PLC0415 - no file, no reader
    from netpos.bags.rsus_file import rsus_text  # noqa: PLC0415

    return rsus_text(read_rsus(Path(file), datum))


def not_usual(config: TrackerConfig) -> dict[str, Any]:
    """The parameters that are not the default."""
    usual = asdict(TrackerConfig())
    return {name: value for name, value in asdict(config).items() if value != usual[name]}


def fusion_fact(networks: tuple[str, ...], config: FusionConfig) -> dict[str, str]:
    """Facts of a bag: the networks and the fusion of their tracks."""
    return {FUSION_FACT: dump_yaml({"networks": list(networks), **asdict(config)})}


def _mapping(bag: BagReader, name: str) -> dict[str, Any] | None:
    """The one value of a fact, None where the bag has none."""
    texts = bag.facts.get(name, ())
    try:
        values = [load_yaml(text) or {} for text in texts]
    except YamlError as error:
        raise BagError(f"{bag.path}: its {name} cannot be read: {error}") from error
    if not all(isinstance(value, dict) for value in values):
        raise BagError(f"{bag.path}: {name!r} is not a mapping of parameters")
    if len(values) > 1:
        first, second = values[:2]
        keys = sorted(key for key in first | second if first.get(key) != second.get(key))
        differences = ", ".join(f"{k} {first.get(k)} and {second.get(k)}" for k in keys)
        raise BagError(f"{bag.path} was tracked with different parameters: {differences}")
    return dict(values[0]) if values else None


def settings_from(source: str) -> TrackerSettings:
    """Settings of a scenario (name or YAML file) or of a bag (folder or .mcap file); defaults for
    no source, or a bag that holds none. The devices of a bag are those its topics name.

    Raises ``ValueError`` naming what is wrong with the source.
    """
    if not source:
        return DEFAULTS
    if Path(source).is_dir() or source.endswith(".mcap"):
        from netpos.bags import BagReader  # noqa: PLC0415 - no bag, no reader

        with BagReader(Path(source)) as bag:
            vue_ids = sorted({topics.split(topic)[0] for topic in bag.topics} - {""})
            known = TRACKER_FACT in bag.facts or FUSION_FACT in bag.facts
            settings = bag_settings(bag) if known else DEFAULTS
            devices, names = tuple(vue_ids) or DEFAULTS.vue_ids, _names_in(bag.topics)
            return replace(settings, vue_ids=devices, names=names)
    return _scenario_settings(source)


def _names_in(bag_topics: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """Names that networks give devices, by network, as the topics of a bag have them."""
    names: dict[str, set[str]] = {}
    for network, vue_id, _ in map(topics.split_network, bag_topics):
        if network:
            names.setdefault(network, set()).add(vue_id)
    return {network: tuple(sorted(own)) for network, own in names.items()}


def _scenario_settings(source: str) -> TrackerSettings:
    from netpos.scenario import load_scenario  # noqa: PLC0415 - a bag of a real run needs none
    from netpos.scenario.networks import names_of  # noqa: PLC0415

    scenario = load_scenario(source)
    return TrackerSettings(
        dict(scenario.tracker),
        tuple(scenario.vue_ids),
        tuple(network.name for network in scenario.networks),
        dict(scenario.fusion),
        {
            network.name: tuple(names_of(scenario, network).values())
            for network in scenario.networks
        },
    )

"""Tracker parameters that come with the input: of a scenario, or of a bag that carries them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from netpos.bags import BagReader
from netpos.bags.single_file import load_yaml
from netpos.messages import topics

# Name of the metadata entry of a bag that holds parameters for its measurements, as YAML.
TRACKER_METADATA = "tracker"
# The same of the networks whose tracks are fused and the parameters of that, as YAML.
FUSION_METADATA = "fusion"


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
    """What each network calls the devices, where it has names of its own."""

    def names_by(self, network: str) -> tuple[str, ...]:
        """What a network calls the devices to expect."""
        return self.names.get(network, self.vue_ids)


DEFAULTS = TrackerSettings()


def bag_settings(metadata: Mapping[str, str]) -> TrackerSettings:
    """Settings a bag carries: its own parameters, else those of the scenario it was made from.

    Raises ``ValueError`` where the scenario it names is not to be found.
    """
    if TRACKER_METADATA not in metadata:
        return _scenario_settings(metadata["scenario"]) if "scenario" in metadata else DEFAULTS
    loaded = _mapping(metadata, TRACKER_METADATA)
    fusion = _mapping(metadata, FUSION_METADATA)
    networks = tuple(map(str, fusion.pop("networks", ())))
    return TrackerSettings(loaded, networks=networks, fusion=fusion)


def as_metadata(parameters: Mapping[str, Any], settings: TrackerSettings) -> dict[str, str]:
    """What a bag says of the ``parameters`` of its tracker, every one of them, and of the networks
    of ``settings``; ``bag_settings`` reads it."""
    metadata = {TRACKER_METADATA: yaml.safe_dump(dict(parameters))}
    if settings.networks:
        fusion = {"networks": list(settings.networks), **settings.fusion}
        metadata[FUSION_METADATA] = yaml.safe_dump(fusion)
    return metadata


def _mapping(metadata: Mapping[str, str], name: str) -> dict[str, Any]:
    loaded = load_yaml(metadata.get(name, "")) or {}
    if not isinstance(loaded, dict):
        raise ValueError(f"the bag's {name!r} metadata is not a mapping of parameters")
    return loaded


def settings_from(source: str) -> TrackerSettings:
    """Settings of a scenario (name or YAML file) or of a bag (folder or .mcap file); defaults for
    no source. The devices of a bag are those its topics name.

    Raises ``ValueError`` naming what is wrong with the source.
    """
    if not source:
        return DEFAULTS
    if Path(source).is_dir() or source.endswith(".mcap"):
        with BagReader(Path(source)) as bag:
            vue_ids = sorted({topics.split(topic)[0] for topic in bag.topics} - {""})
            settings = bag_settings(bag.metadata)
            return replace(settings, vue_ids=tuple(vue_ids) or DEFAULTS.vue_ids)
    return _scenario_settings(source)


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

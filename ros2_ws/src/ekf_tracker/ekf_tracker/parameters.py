"""Parameters of the tracker node: declared once, read when it is configured, some of them changed
while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from netpos.messages.topics import is_vue_id
from netpos.messages.values import RsuInfo
from netpos.scenario.settings import TrackerSettings, list_of, settings_from
from netpos.tracking import Tracker, TrackerConfig
from netpos.tracking.live_parameters import changed_names
from netpos_node import declare, declare_config
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

_OF_CONFIG = frozenset(entry.name for entry in fields(TrackerConfig))
_WHEN_CONFIGURED = ("vues", "rsus_file", "publish_tf", "subscribers")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerParameters:
    """What the node is configured with."""

    config: TrackerConfig
    settings: TrackerSettings
    vue_ids: tuple[str, ...]
    publish_tf: bool
    subscribers: int

    @property
    def rsu_list(self) -> list[RsuInfo]:
        """The network's own list of RSUs."""
        return self.settings.rsu_list


class Parameters:
    """The parameters of a node; a scenario or a bag gives defaults, explicit values win."""

    def __init__(self, node: Node) -> None:
        """Declares all. Raises ``ValueError`` for a bad value."""
        self._node = node
        text = "scenario (name or YAML) or bag whose tracker parameters and devices are defaults"
        self._settings = settings_from(declare(node, "scenario", "", text))
        defaults = TrackerConfig.from_mapping(self._settings.parameters)
        config = declare_config(node, TrackerConfig, asdict(defaults), read_only=False)
        text = "devices whose topics exist from the start; others appear with their first fix"
        names = list(self._settings.names_by(config.network))
        declare(node, "vues", names, text, read_only=False)
        text = "YAML or CSV file with the network's own RSUs; default: the list of the bag, if any"
        declare(node, "rsus_file", "", text, read_only=False)
        text = "publish transforms on /tf; a tracker of one network among several never does"
        declare(node, "publish_tf", True, text, read_only=False)
        text = (
            "listen to measurements once the estimates have so many subscribers (or after 30 s);"
            " tracks of a network need one more, the fusion"
        )
        declare(node, "subscribers", 0, text, low=0, read_only=False)
        self.read()

    def read(self) -> TrackerParameters:
        """The values as they are. Raises ``ValueError`` for a bad one."""
        return self._with({})

    def watch(
        self, tracker: Callable[[], Tracker | None], on_change: Callable[[Sequence[str]], None]
    ) -> None:
        """Judge and apply changes from now on, all of one request or none. ``tracker``: the core
        of the node while it is configured; ``on_change`` is told what of it changed."""

        def judge(wanted: list[Parameter]) -> SetParametersResult:
            core = tracker()
            try:
                self._judge({one.name: one.value for one in wanted}, core)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
            return SetParametersResult(successful=True)

        def apply(_: list[Parameter]) -> None:
            core = tracker()
            if core is None:
                return
            new = self.read().config
            names = changed_names(core.config, new)
            if names:
                core.set_config(new)
                on_change(names)

        self._node.add_on_set_parameters_callback(judge)
        self._node.add_post_set_parameters_callback(apply)

    def _judge(self, wanted: Mapping[str, Any], core: Tracker | None) -> None:
        """Raises ``ValueError`` for values that cannot be, or not now."""
        mine = {n: v for n, v in wanted.items() if n in _OF_CONFIG or n in _WHEN_CONFIGURED}
        if not mine:
            return
        later = [name for name in _WHEN_CONFIGURED if name in mine]
        if core is not None and later:
            raise ValueError(
                f"{', '.join(later)} cannot change while the tracker is configured; clean the"
                " node up or start it anew"
            )
        new = self._with(mine)
        if core is not None:
            core.check_config(new.config)

    def _with(self, changes: Mapping[str, Any]) -> TrackerParameters:
        """The values with some ``changes``."""

        def value(name: str) -> Any:
            return changes[name] if name in changes else self._node.get_parameter(name).value

        config = TrackerConfig(**{name: value(name) for name in _OF_CONFIG})
        vue_ids = tuple(value("vues") or ())
        for vue_id in vue_ids:
            if not is_vue_id(vue_id):
                raise ValueError(f"vues: {vue_id!r} is no device name; use letters, digits and _")
        if config.network and not is_vue_id(config.network):
            raise ValueError(
                f"network: {config.network!r} is no name of a network; use letters, digits and _"
            )
        rsus = list_of(value("rsus_file"), config.datum) or self._settings.rsus
        return TrackerParameters(
            settings=replace(self._settings, rsus=rsus),
            vue_ids=vue_ids,
            publish_tf=value("publish_tf") and not config.network,
            subscribers=value("subscribers"),
            config=config,
        )

"""Parameters of the fusion node."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from netpos.messages.topics import is_vue_id
from netpos.scenario.settings import settings_from
from netpos.tracking.networks.config import FusionConfig
from netpos_node import declare, declare_config
from rclpy.node import Node


@dataclass(frozen=True, slots=True, kw_only=True)
class FusionParameters:
    """Everything the node reads at start."""

    config: FusionConfig
    networks: tuple[str, ...]
    vue_ids: tuple[str, ...]
    publish_tf: bool
    subscribers: int


def declare_parameters(node: Node) -> FusionParameters:
    """Declare and read all parameters; a scenario or a bag gives defaults, explicit values win.

    Raises ``ValueError`` for a bad value.
    """
    text = "scenario (name or YAML) or bag whose networks, devices and settings are the defaults"
    settings = settings_from(declare(node, "scenario", "", text))
    config = declare_config(node, FusionConfig, asdict(FusionConfig.from_mapping(settings.fusion)))
    text = "networks whose tracks are fused; the first one's names of devices are kept"
    networks = tuple(declare(node, "networks", list(settings.networks or [""]), text) or [""])
    text = "devices whose topics exist from the start; others appear when first heard"
    vue_ids = tuple(declare(node, "vues", list(settings.names_by(networks[0])), text) or ())
    for kind, names in (("networks", networks), ("vues", vue_ids)):
        for name in names:
            if not is_vue_id(name):
                raise ValueError(
                    f"{kind}: {name!r} is no name; give at least one of letters, digits and _"
                )
    return FusionParameters(
        config=config,
        networks=networks,
        vue_ids=vue_ids,
        publish_tf=declare(node, "publish_tf", True, "publish map_frame -> base_frame on /tf"),
        subscribers=declare(
            node,
            "subscribers",
            0,
            "listen to tracks once the estimates have so many subscribers (or after 30 s)",
            low=0,
        ),
    )

"""Parameters of the tracker node."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

from netpos.messages.topics import is_vue_id
from netpos.scenario.settings import TrackerSettings, list_of, settings_from
from netpos.tracking import TrackerConfig
from netpos_node import declare, declare_config
from rclpy.node import Node


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerParameters:
    """Everything the node reads at start."""

    config: TrackerConfig
    settings: TrackerSettings
    vue_ids: tuple[str, ...]
    publish_tf: bool
    subscribers: int


def declare_parameters(node: Node) -> TrackerParameters:
    """Declare and read all parameters; a scenario or a bag gives defaults, explicit values win."""
    text = "scenario (name or YAML) or bag whose tracker parameters and devices are the defaults"
    settings = settings_from(declare(node, "scenario", "", text))
    defaults = TrackerConfig.from_mapping(settings.parameters)
    config = declare_config(node, TrackerConfig, asdict(defaults))
    text = "devices whose topics exist from the start; others appear when first heard"
    vue_ids = tuple(declare(node, "vues", list(settings.names_by(config.network)), text) or ())
    for vue_id in vue_ids:
        if not is_vue_id(vue_id):
            raise ValueError(f"vues: {vue_id!r} is no device name; use letters, digits and _")
    if config.network and not is_vue_id(config.network):
        raise ValueError(
            f"network: {config.network!r} is no name of a network; use letters, digits and _"
        )
    text = "YAML or CSV file with the network's own RSUs; default: the list of the bag, if any"
    rsus = list_of(declare(node, "rsus_file", "", text)) or settings.rsus
    settings = replace(settings, rsus=rsus)
    text = "publish map -> base_link on /tf; a tracker of one network among several never does"
    return TrackerParameters(
        settings=settings,
        vue_ids=vue_ids,
        publish_tf=declare(node, "publish_tf", True, text) and not config.network,
        subscribers=declare(
            node,
            "subscribers",
            0,
            "listen to measurements once the estimates have so many subscribers (or after 30 s);"
            " tracks of a network need one more, the fusion",
            low=0,
        ),
        config=config,
    )

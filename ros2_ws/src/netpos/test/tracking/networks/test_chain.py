"""All stages in one process: what a bag with networks replays to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from netpos.bags import BagReader
from netpos.messages.topics import of_vue
from netpos.scenario import load_scenario
from netpos.scenario.offline import simulate_to_bag
from netpos.scenario.replay import replay_bag
from netpos.scenario.settings import bag_settings, settings_from


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("chain") / "simulated"
    changes = {"max_duration_s": 12.0, "devices.0.count": 2}
    changes |= {"devices.0.route.start": [10680.0, 3700.0]}
    simulate_to_bag(load_scenario("two_networks", changes=changes), path)
    return path


def messages(bag: Path, topic: str) -> list[Any]:
    with BagReader(bag) as reader:
        return [entry.message for entry in reader.messages([topic])]


def fused(bag: Path) -> list[str]:
    """Devices of the fusion: two, and what the Wi-Fi calls them until WiMAX hears them, too."""
    with BagReader(bag) as reader:
        found = [topic.split("/")[1] for topic in reader.topics if topic.endswith("/odometry")]
    vues = sorted(set(found) - {"networks"})
    assert {"vue_1", "vue_2"} <= set(vues) <= {"vue_1", "vue_2", "wifi_wifi_1", "wifi_wifi_2"}
    return vues


def test_replay_writes_every_stage(simulated: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    replay_bag(simulated, out)
    with BagReader(out) as bag:
        counts = {topic: info.count for topic, info in bag.topics.items()}
    assert counts["/networks/wifi/tracks"] > 20
    assert counts["/networks/wifi/wifi_1/odometry"] > 10
    assert counts["/networks/wimax/vue_2/odometry"] > 10
    assert counts[of_vue("vue_1", "odometry")] > 20
    assert counts["/tf"] == sum(counts[of_vue(vue, "odometry")] for vue in fused(out))


def test_a_replay_replays_to_the_same_bytes(simulated: Path, tmp_path: Path) -> None:
    bags = [tmp_path / "once", tmp_path / "twice"]
    replay_bag(simulated, bags[0])
    replay_bag(bags[0], bags[1])
    found = []
    for path in bags:
        with BagReader(path) as bag:
            found.append([(e.topic, e.cdr) for e in bag.messages(sorted(bag.topics))])
    assert found[0] == found[1]


def test_parameters_of_the_fusion_can_be_set(simulated: Path, tmp_path: Path) -> None:
    """Two devices on one way cannot be told apart by their motion: by their names they can."""
    out = tmp_path / "apart"
    replay_bag(simulated, out)
    assert all(s.used == 1 for s in messages(out, "/vue_1/track_status"))
    with BagReader(out) as bag:
        assert bag_settings(bag).networks == ("wimax", "wifi")
    stale = tmp_path / "stale"
    replay_bag(simulated, stale, {"fusion.association": "names", "fusion.method": "ci"})
    with BagReader(stale) as bag:
        assert bag_settings(bag).fusion["method"] == "ci"
        assert "/wifi_1/odometry" in bag.topics
    with pytest.raises(ValueError, match="unknown fusion parameter 'rule'"):
        replay_bag(simulated, tmp_path / "no", {"fusion.rule": "ci"})


def test_several_networks_are_not_smoothed(simulated: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="leave --smooth out"):
        replay_bag(simulated, tmp_path / "no", smooth=True)


def test_settings_of_scenario_and_bag(simulated: Path) -> None:
    for source in ("two_networks", str(simulated)):
        settings = settings_from(source)
        assert settings.networks == ("wimax", "wifi")
        assert settings.fusion["hold_s"] == 2.0
    assert settings_from("fast_pass").networks == ()


def test_names_that_networks_give_devices(simulated: Path, tmp_path: Path) -> None:
    """Of a scenario, and of a bag that holds estimates of the networks."""
    out = tmp_path / "out"
    replay_bag(simulated, out)
    for source, count in (("two_networks", 1), (str(out), 2)):
        settings, numbers = settings_from(source), range(1, count + 1)
        assert settings.names_by("wifi") == tuple(f"wifi_{k}" for k in numbers)
        assert settings.names_by("wimax") == tuple(f"vue_{k}" for k in numbers)


def test_a_single_network_has_no_fusion_to_set(tmp_path: Path) -> None:
    bag = tmp_path / "one"
    simulate_to_bag(load_scenario("fast_pass"), bag)
    with pytest.raises(ValueError, match=r"no fusion\.method to set"):
        replay_bag(bag, tmp_path / "out", {"fusion.method": "ci"})


def test_every_stage_has_the_frames_it_is_given(simulated: Path, tmp_path: Path) -> None:
    """The fused track has a name of its own for the body."""
    out = tmp_path / "out"
    replay_bag(
        simulated, out, {"base_frame": "{vue}_of_network", "fusion.base_frame": "{vue}_body"}
    )
    for topic, child in (
        ("/vue_1/odometry", "vue_1_body"),
        ("/networks/wimax/vue_1/odometry", "vue_1_of_network"),
    ):
        found = {(m.header.frame_id, m.child_frame_id) for m in messages(out, topic)}
        assert found == {("map", child)}
    sent = [t for m in messages(out, "/tf") for t in m.transforms]
    assert {(t.header.frame_id, t.child_frame_id) for t in sent} == {
        ("map", f"{vue}_body") for vue in fused(out)
    }


def test_tracks_of_another_map_are_refused(simulated: Path, tmp_path: Path) -> None:
    summary = replay_bag(simulated, tmp_path / "odd", {"fusion.map_frame": "site"})
    counts = summary.rejected["fusion"]
    assert set(counts) == {"wifi: frame", "wimax: frame"}
    assert min(counts.values()) > 20

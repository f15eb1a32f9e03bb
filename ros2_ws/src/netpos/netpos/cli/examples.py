"""An example or two for the help of each command; the tests parse every one of them."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[str, ...]] = {
    "scenarios": ("netpos scenarios",),
    "run": (
        "netpos run fast_pass --offline --bag my_run",
        "netpos run metis_madrid --bag my_live_run --rate 10",
    ),
    "replay": (
        "netpos replay my_run --out my_track --set hold_s=0.1",
        "netpos replay my_run --out my_smooth_track --smooth",
    ),
    "evaluate": (
        "netpos evaluate my_run --json figures.json --map map.png --bounds bounds.png",
        "netpos evaluate my_run --truth walk.tum --truth-time-offset auto",
    ),
    "report": ("netpos report my_run --out report.html",),
    "compare": ("netpos compare my_run my_track --json differences.json",),
    "sweep": (
        "netpos sweep fast_pass --vary tracker.hold_s=0,0.1 --runs 20 --out t.csv --plot t.png",
    ),
    "faults": (
        "netpos faults fast_pass --out faults.md --json faults.json",
        "netpos faults fast_pass my_site.yaml --plan faults.yaml",
    ),
    "watch": ("netpos watch", "netpos watch ws://192.168.1.20:8765 --once"),
    "bench": ("netpos bench --json speed.json",),
    "reproduce": ("netpos reproduce fokin2020 --runs 20 --json rows.json --out pictures",),
    "recover": ("netpos recover my_run",),
    "params": ("netpos params hold", "netpos params --dump params.yaml --from fast_pass"),
    "geojson": ("netpos geojson my_track my_track.geojson --datum '55.75, 37.62, 150'",),
    "import csv": (
        "netpos import csv uwb.csv my_bag --map time=t,rsu=anchor,range=dist --units "
        "time=ms,range=mm --sd range=100 --rsus anchors.yaml",
        'netpos import csv uwb.tsv my_bag --map "time=1,range:a1=6,range:a2=7,range:a3=8" '
        "--sd range=0.1 --rsus anchors.csv --truth walk.tum",
    ),
    "import ros": (
        "netpos import ros walk.bag my_bag --topic /uwb --map time=header.stamp,rsu=responder_id,"
        "range=distance,rsu_x=place.x,rsu_y=place.y,rsu_z=place.z --sd range=0.1 "
        "--truth-topic /pose --truth-map time=header.stamp,x=pose.position.x,y=pose.position.y",
    ),
    "import ble-aoa": ("netpos import ble-aoa FOLDER my_bag --run uc1_run1",),
    "import uwb-anchors": ("netpos import uwb-anchors FOLDER my_bag",),
    "import uwb-trolley": ("netpos import uwb-trolley FOLDER my_bag",),
    "import car-imu-rtk": ("netpos import car-imu-rtk FOLDER my_bag --nearest 2 --fewest 1",),
    "import waist-imu": ("netpos import waist-imu data.mat my_bag",),
    "import steps-phone": ("netpos import steps-phone walk.csv my_bag",),
    "import pdr-phone": ("netpos import pdr-phone walk.txt my_bag",),
    "rsus save": ("netpos rsus save my_track rsus.yaml",),
    "rsus load": ("netpos rsus load rsus.yaml other_run other_run_described",),
}


def epilog(command: str) -> str:
    """The examples as text below the help of a command."""
    examples = EXAMPLES.get(command, ())
    return "\n\n".join(["Examples:", *examples]) if examples else ""

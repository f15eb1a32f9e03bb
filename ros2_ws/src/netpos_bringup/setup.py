from glob import glob

from setuptools import find_packages, setup

setup(
    name="netpos_bringup",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/netpos_bringup"]),
        ("share/netpos_bringup", ["package.xml"]),
        ("share/netpos_bringup/launch", sorted(glob("launch/*.launch.py"))),
        ("share/netpos_bringup/scenarios", sorted(glob("scenarios/*.yaml"))),
        ("share/netpos_bringup/sros2", ["sros2/policy.xml"]),
        ("share/netpos_bringup/rviz", ["rviz/netpos.rviz"]),
        ("share/netpos_bringup/foxglove", ["foxglove/netpos.json"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Scenarios, launch files, the live view, the processes that measure the node.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "bench_probe = netpos_bringup.bench_probe:main",
            "bench_relay = netpos_bringup.bench_relay:main",
            "faults = netpos_bringup.faults:main",
            "live = netpos_bringup.live:main",
            "viz = netpos_bringup.viz:main",
        ],
    },
)

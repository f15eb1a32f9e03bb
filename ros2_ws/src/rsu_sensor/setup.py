from setuptools import find_packages, setup

setup(
    name="rsu_sensor",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/rsu_sensor"]),
        ("share/rsu_sensor", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="RSU node: DOA/TOA measurements of device beacons.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "rsu_sensor = rsu_sensor.node:main",
        ],
    },
)

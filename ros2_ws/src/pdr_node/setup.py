from setuptools import find_packages, setup

setup(
    name="pdr_node",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/pdr_node"]),
        ("share/pdr_node", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Pedestrian dead reckoning node: IMU and magnetometer to step velocities.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "pdr_node = pdr_node.node:main",
        ],
    },
)

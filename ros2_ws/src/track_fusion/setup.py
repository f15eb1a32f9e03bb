from setuptools import find_packages, setup

setup(
    name="track_fusion",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/track_fusion"]),
        ("share/track_fusion", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Fusion node: the tracks of several networks to one odometry per device.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "track_fusion = track_fusion.node:main",
        ],
    },
)

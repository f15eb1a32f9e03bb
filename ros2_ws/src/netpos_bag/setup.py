from setuptools import find_packages, setup

setup(
    name="netpos_bag",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/netpos_bag"]),
        ("share/netpos_bag", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Record and play MCAP bags of a running graph.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "record = netpos_bag.record:main",
            "play = netpos_bag.play:main",
        ],
    },
)

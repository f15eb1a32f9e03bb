from setuptools import find_packages, setup

setup(
    name="netpos_node",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={"netpos_node": ["fastdds.xml"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/netpos_node"]),
        ("share/netpos_node", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    description="What every node needs: start, parameters, QoS, message conversion.",
    license="Apache-2.0",
)

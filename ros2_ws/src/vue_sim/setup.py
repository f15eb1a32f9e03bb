from setuptools import find_packages, setup

setup(
    name="vue_sim",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/vue_sim"]),
        ("share/vue_sim", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Device node: true motion, IMU, magnetometer, uplink beacon, /clock.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "vue_sim = vue_sim.node:main",
        ],
    },
)

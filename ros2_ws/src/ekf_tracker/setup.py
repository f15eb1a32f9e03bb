from setuptools import find_packages, setup

setup(
    name="ekf_tracker",
    version="0.1.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/ekf_tracker"]),
        ("share/ekf_tracker", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    description="Tracker node: RSU measurements and step velocities to odometry and clock state.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "ekf_tracker = ekf_tracker.node:main",
        ],
    },
)

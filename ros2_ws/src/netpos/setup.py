from setuptools import find_packages, setup

setup(
    name="netpos",
    version="0.1.0",
    package_data={
        "netpos": ["py.typed"],
        "netpos.evaluation.bench": ["*.c"],
        "netpos.evaluation.report": ["*.html", "*.js"],
    },
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/netpos"]),
        ("share/netpos", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"cluster": ["ray"], "parquet": ["pyarrow"]},
    zip_safe=True,
    description="The netpos library: world, radio, filters, tracking, evaluation. No ROS inside.",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "netpos = netpos.cli.main:main",
        ],
    },
)

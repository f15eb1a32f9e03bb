import re
from pathlib import Path

from setuptools import find_packages, setup

here = Path(__file__).parent
version = re.search(
    r'__version__ = "([^"]+)"', (here / "netpos" / "__init__.py").read_text(encoding="utf-8")
)

setup(
    name="netpos",
    version=version.group(1),
    description="Positions vehicles and pedestrians from the network side. No ROS inside.",
    license="Apache-2.0",
    python_requires=">=3.11",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={
        "netpos": ["py.typed"],
        # Links to where ROS has them; packages hold the files themselves.
        "netpos.bags": ["msg/*.msg"],
        "netpos.scenario": ["scenarios/*.yaml"],
        "netpos.bench": ["*.c"],
        "netpos.evaluation.faults": ["*.yaml"],
        "netpos.evaluation.report": ["*.html", "*.js"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/netpos"]),
        ("share/netpos", ["package.xml"]),
    ],
    install_requires=[
        "evo>=1.30",
        "jinja2>=3.1",
        "lz4>=4.3",
        "matplotlib>=3.8",
        "mcap>=1.2",
        "numba>=0.60",
        "numpy>=2.0",
        "pandas>=2.2",
        "pillow>=10",
        "plotly>=6.0",
        "pydantic>=2.7",
        "pyproj>=3.6",
        "pyyaml>=6.0",
        "rich>=13.7",
        "rosbags>=0.10.4",
        "scipy>=1.15",
        "threadpoolctl>=3.4",
        "typer>=0.12",
        "vqf>=2.0",
        "websockets>=13.0",
        "zstandard>=0.22",
    ],
    extras_require={
        "bench": ["filterpy"],
        "cluster": ["ray"],
        "parquet": ["pyarrow"],
    },
    zip_safe=False,
    entry_points={"console_scripts": ["netpos = netpos.cli.main:main"]},
)

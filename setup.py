import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = "biped_mfpt_ros"
VERSION = re.search(r'__version__ = "(.+)"', Path(NAME, "__init__.py").read_text()).group(1)

setup(
    name=NAME,
    version=VERSION,
    description="Mean first-passage time to a fall of a five-link biped on rough ground",
    license="Apache-2.0",
    maintainer="biped_mfpt_ros maintainers",
    maintainer_email="maintainers@example.org",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["data/*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
    ],
    python_requires=">=3.10",
    zip_safe=False,
    entry_points={
        "console_scripts": [
            f"biped-mfpt = {NAME}.cli:main",
            *(
                f"{node} = {NAME}.nodes.{node}:main"
                for node in ("simulator", "mesher", "analysis", "recorder", "optimiser")
            ),
        ]
    },
)

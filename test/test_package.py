"""package.xml, setup.py, requirements and message definitions agree with the code."""

import ast
import importlib.metadata
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from ament_index_python.packages import get_package_prefix, get_package_share_directory

import biped_mfpt_ros

PACKAGE = "biped_mfpt_ros"
ROOT = Path(__file__).parents[1]
NODES = {"simulator", "mesher", "analysis", "recorder", "optimiser"}

ROSDEP_KEYS = {
    "PIL": "python3-pil",
    "cmaes": "cmaes",
    "hypothesis": "python3-hypothesis",
    "llvmlite": "python3-numba",  # which cannot be without it
    "matplotlib": "python3-matplotlib",
    "mcap": "mcap-ros2-support",
    "mpmath": "python3-sympy",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pymoo": "pymoo",
    "pytest": "python3-pytest",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
    "zstandard": "mcap-ros2-support",
}
"""Of what is on the Python package index. mcap, zstandard, mpmath: the key that brings them."""
OPTIONAL = {"mujoco"}
"""What a benchmark compares with where it is installed."""
PIP_NAMES = {"PIL": "pillow", "llvmlite": "numba", "yaml": "pyyaml"}
"""Import name to name on the package index, where they differ."""

ENTRY_POINTS = importlib.metadata.distribution(PACKAGE).entry_points.select(group="console_scripts")
DEFINITIONS = sorted(
    path for kind in ("msg", "srv", "action") for path in ROOT.glob(f"msg_defs/{kind}/*.{kind}")
)


def manifest(path):
    return ElementTree.parse(ROOT / path / "package.xml").getroot()


def dependencies(*kinds):
    return {element.text for kind in kinds for element in manifest("").iter(kind)}


def requirements(name):
    lines = (ROOT / "requirements" / name).read_text().splitlines()
    return {re.match(r"[\w-]+", line)[0] for line in lines if re.match(r"\w", line)}


def imports(folder):
    """Top-level names that the modules under a folder import from elsewhere."""
    names = set()
    paths = list((ROOT / folder).rglob("*.py"))
    own = {PACKAGE, *(path.stem for path in paths if path.parent == ROOT / folder)}
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names.update(alias.name.split(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(node.module.split(".")[0])
    return names - own - OPTIONAL - sys.stdlib_module_names


def test_version_is_the_same_everywhere():
    versions = {manifest(path).findtext("version") for path in ("", "msg_defs")}
    versions.add(importlib.metadata.version(PACKAGE))
    assert versions == {biped_mfpt_ros.__version__}


def test_every_node_and_the_command_line_are_executables():
    assert {entry.name for entry in ENTRY_POINTS} == NODES | {"biped-mfpt"}


@pytest.mark.parametrize("entry", ENTRY_POINTS, ids=lambda entry: entry.name)
def test_executable_imports_and_is_where_ros2_run_looks(entry):
    assert callable(entry.load())
    file = Path(get_package_prefix(PACKAGE), "lib", PACKAGE, entry.name)
    assert file.stat().st_mode & 0o111


def test_launch_file_is_installed_and_starts_every_node():
    file = Path(get_package_share_directory(PACKAGE), "launch", "pipeline.launch.py")
    tree = ast.parse(file.read_text())
    strings = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
    assert strings >= NODES


@pytest.mark.parametrize(
    ("folder", "kinds"),
    [
        (PACKAGE, ["exec_depend"]),
        ("launch", ["exec_depend"]),
        ("test", ["exec_depend", "test_depend"]),
    ],
)
def test_imports_are_declared_in_package_xml(folder, kinds):
    assert {ROSDEP_KEYS.get(name, name) for name in imports(folder)} <= dependencies(*kinds)


def test_requirements_are_what_is_imported():
    def from_the_index(names):
        return {PIP_NAMES.get(name, name) for name in names if name in ROSDEP_KEYS}

    assert requirements("run.txt") == from_the_index(imports(PACKAGE))
    assert from_the_index(imports("test")) <= requirements("run.txt") | requirements("dev.txt")


def test_every_definition_is_built():
    listed = (ROOT / "msg_defs/CMakeLists.txt").read_text()
    built = re.findall(r"(?:msg|srv|action)/\w+\.\w+", listed)
    assert sorted(built) == sorted(f"{path.parent.name}/{path.name}" for path in DEFINITIONS)


@pytest.mark.parametrize("path", DEFINITIONS, ids=lambda path: path.name)
def test_every_field_has_a_comment(path):
    bare = [
        line
        for line in path.read_text().splitlines()
        if line.strip() and line.strip() != "---" and not re.search(r"#\s*\S", line)
    ]
    assert bare == []

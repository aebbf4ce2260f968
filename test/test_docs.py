"""What README.md and docs/ print works: commands are understood, Python runs."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from biped_mfpt_ros.cli.parser import make_parser

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
WITHOUT_ROS = "import sys; sys.modules['rclpy'] = sys.modules['biped_mfpt_msgs'] = None\n"


def blocks(page, language):
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)


def commands(page):
    """Every command line of `biped-mfpt`, of code and of text, with shell variables put in."""
    text = "".join(f"{block}\n" for block in blocks(page, "sh")).replace("\\\n", " ")
    variables = dict(re.findall(r'^(\w+)="(.*)"$', text, re.MULTILINE))
    text += "\n".join(re.findall(r"`(biped-mfpt [a-z]+ --[^`]*)`", page.read_text()))
    for line in re.findall(r"^(?:\w+=\w+ )?biped-mfpt (.*)$", text, re.MULTILINE):
        for name, value in variables.items():
            line = line.replace(f"${name}", value)
        words = shlex.split(line, comments=True)
        yield words[: words.index(">")] if ">" in words else words


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_are_understood(page):
    for words in commands(page):
        make_parser().parse_args(words)


def test_commands_are_found():
    found = [words for page in PAGES for words in commands(page)]
    assert len(found) > 30
    assert ["controllers", "hzd/mfpt", "--robot-file", "robot.json"] in found


@pytest.mark.parametrize(
    ("page", "index"),
    [
        ("README.md", 0),
        ("docs/robot.md", 0),
        ("docs/robot.md", 1),
        pytest.param("docs/optimise.md", 0, marks=pytest.mark.slow),
    ],
)
def test_python_runs_without_ros(page, index, tmp_path):
    for text in blocks(ROOT / page, "json"):
        (tmp_path / "robot.json").write_text(text)
    code = WITHOUT_ROS + blocks(ROOT / page, "python")[index]
    ended = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert ended.returncode == 0, ended.stderr
    assert float(ended.stdout.split()[0]) > 0.0

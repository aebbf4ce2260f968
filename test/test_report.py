"""What readers see: progress, tables, the paper's figures, pictures."""

from __future__ import annotations

import io
import json
import math
from importlib.resources import files

import numpy as np
import pytest

from biped_mfpt_ros.control.controller import controller, paper_controller_names
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.report import paper, pictures
from biped_mfpt_ros.report.progress import MeshProgress, Progress, duration_text, rate_text
from biped_mfpt_ros.report.tables import difference, number, plural, table
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import SLOPE_LIMIT


class Terminal(io.StringIO):
    def isatty(self):
        return True


class Clock:
    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    made = Clock()
    monkeypatch.setattr("biped_mfpt_ros.report.progress.time", made)
    return made


class TestProgress:
    @pytest.mark.parametrize(
        ("seconds", "text"),
        [
            (0.04, "0.0 s"),
            (9.94, "9.9 s"),
            (9.96, "10 s"),
            (59.4, "59 s"),
            (59.6, "1 min 00 s"),
            (185.0, "3 min 05 s"),
            (3599.6, "1 h 00 min"),
            (7620.0, "2 h 07 min"),
        ],
    )
    def test_duration(self, seconds, text):
        assert duration_text(seconds) == text

    @pytest.mark.parametrize(
        ("rate", "text"), [(0.5119, "0.512"), (87.31, "87.3"), (12345.0, "12300"), (999.6, "1000")]
    )
    def test_rate(self, rate, text):
        assert rate_text(rate) == text

    def test_terminal_redraws_one_line_and_takes_it_away(self, clock):
        stream = Terminal()
        with Progress(stream=stream) as progress:
            progress.show("one")
            progress.show("too soon")
            clock.now += 1.0
            progress.show("two")
        assert stream.getvalue() == "\rone\x1b[K\rtwo\x1b[K\r\x1b[K"

    def test_a_log_has_no_line_twice_in_a_row(self, clock):
        stream = io.StringIO()
        with Progress(stream=stream) as progress:
            for text in ("one", "one", "two", "one"):
                clock.now += 60.0
                progress.show(text)
        assert stream.getvalue() == "one\ntwo\none\n"

    def test_a_long_line_does_not_wrap(self, clock):
        stream = Terminal()
        Progress(stream=stream).show("x" * 500)
        assert stream.getvalue() == "\r" + "x" * 79 + "\x1b[K"

    def test_lines_that_stay_are_written_above(self, clock):
        stream = Terminal()
        with Progress(stream=stream) as progress:
            progress.show("one")
            progress.say("news")
            progress.show("two")
        assert stream.getvalue() == "\rone\x1b[K\r\x1b[Knews\n\rtwo\x1b[K\r\x1b[K"

    def test_a_log_gets_a_line_now_and_then(self, clock):
        stream = io.StringIO()
        with Progress(stream=stream) as progress:
            for second in range(25):
                progress.show(f"at {second}")
                clock.now += 1.0
        assert stream.getvalue() == "at 10\nat 20\n"

    def test_quiet_is_silent(self, clock):
        stream = Terminal()
        with Progress(quiet=True, stream=stream) as progress:
            progress.show("one")
            progress.say("two")
            progress.count("three", 1, 2, "things")
        assert stream.getvalue() == ""

    def test_rate_and_time_left_are_those_since_counting_began(self, clock):
        stream = Terminal()
        progress = Progress(stream=stream)
        clock.now += 20.0  # compiling
        progress.count("walks", 100, 1000, "walks")
        clock.now += 2.0
        progress.count("walks", 300, 1000, "walks")
        # 200 in 2 s, so 700 more take 7 s.
        assert "walks: 300 of 1000 walks, 100/s, 7.0 s left" in stream.getvalue()
        clock.now += 20.0
        progress.count("meshes", 0, 50, "meshes")
        clock.now += 2.0
        progress.count("meshes", 10, 50, "meshes")
        assert "meshes: 10 of 50 meshes, 5/s, 8.0 s left" in stream.getvalue()

    def test_mesh_has_no_time_left_while_it_grows(self):
        mesh = MeshProgress()
        text = mesh.text(generation=1, states=11, frontier=10, swings_per_second=0.0)
        assert text == "mesh: 11 states, frontier 10, 0 swings/s, still growing"
        text = mesh.text(generation=2, states=111, frontier=100, swings_per_second=50.0)
        assert "still growing" in text

    def test_mesh_estimate_is_a_geometric_series_once_it_shrinks(self):
        mesh = MeshProgress()
        mesh.text(generation=1, states=101, frontier=100, swings_per_second=10.0)
        text = mesh.text(generation=2, states=151, frontier=50, swings_per_second=10.0)
        # 50 now, then 25, 12.5, ...: 100 swings at 10 a second.
        assert "about 10 s left" in text
        text = mesh.text(
            generation=2, states=151, frontier=20, swings_per_second=10.0, simulators=2
        )
        assert text == (
            "mesh: 151 states, frontier 20, 10 swings/s, about 7.0 s left, 2 simulators"
        )
        text = mesh.text(generation=2, states=151, frontier=0, swings_per_second=10.0)
        assert text == "mesh: 151 states, frontier 0, 10 swings/s, finishing"


class TestTables:
    def test_alignment(self):
        text = table(("name", "value"), [("a", 1.0), ("long name", None)])
        assert text.splitlines() == [
            "name       value",
            "---------  -----",
            "a              1",
            "long name      -",
        ]

    def test_wrong_number_of_cells(self):
        with pytest.raises(ValueError, match="1 cells under 2 headers"):
            table(("a", "b"), [("x",)])

    @pytest.mark.parametrize(
        ("value", "text"),
        [
            (None, "-"),
            (3, "3"),
            (0.0, "0"),
            (5.52064, "5.5206"),
            (113.1, "113.1"),
            (1.6e14, "1.600e+14"),
            (1e-9, "1.000e-09"),
            (math.inf, "inf"),
        ],
    )
    def test_number(self, value, text):
        assert number(value) == text

    def test_plural(self):
        assert [plural(n, "state") for n in (0, 1, 2)] == ["0 states", "1 state", "2 states"]

    def test_difference(self):
        assert difference(110.0, 100.0) == "+10.0 %"
        assert difference(97.5, 100.0) == "-2.5 %"
        assert difference(1.6e14, 1e9) == "x 1.600e+05"
        assert difference(1.0, 2000.0) == "x 5.000e-04"
        assert difference(math.inf, 1.0) == "x inf"


class TestPaper:
    def test_table_5(self):
        assert [paper.mfpt(name, 0.0, 1.0) for name in paper_controller_names()] == [
            5.9, 7.3, 113.1, 3.2e5, 2.2, 1.6e14,
        ]  # fmt: skip

    def test_tables_2_and_4(self):
        data = json.loads(files("biped_mfpt_ros").joinpath("data/paper.json").read_text())
        for name in paper_controller_names():
            scheme, label = name.split("/")
            sigma, key = {
                "hzd": (2.0, "table2_hzd_sigma2"),
                "smc": (5.0, "table4_smc_sigma5"),
            }[scheme]
            assert paper.monte_carlo(name, 0.0, sigma) == data[key]["monte_carlo"][label]
            assert paper.mfpt(name, 0.0, sigma) == data[key]["estimate_eq34"][label]

    def test_silent_where_the_paper_is(self):
        assert paper.mfpt("hzd/mfpt", 0.0, 1.5) is None
        assert paper.mfpt("hzd/mfpt", 1.0, 1.0) is None
        assert paper.mfpt("hzd/mine", 0.0, 1.0) is None
        assert paper.mfpt("mine", 0.0, 1.0) is None
        assert paper.monte_carlo("hzd/mfpt", 0.0, 5.0) is None
        assert paper.monte_carlo("mine", 0.0, 2.0) is None
        assert paper.speed("hzd/cot") is None
        assert paper.speed("hzd/base", -1.0) is None
        assert paper.cost_of_transport("hzd/cot") is None

    def test_flat_ground(self):
        assert paper.speed("hzd/base") == 0.8
        assert paper.cost_of_transport("hzd/base") == 0.1865
        assert paper.cost_of_transport("hzd/mfpt") == 0.1411


@pytest.fixture(scope="module")
def cycle():
    return find_limit_cycle(controller("hzd/mfpt"))


class TestPictures:
    def test_links_keep_their_lengths(self):
        states = np.random.default_rng(1).uniform(-4.0, 4.0, (50, 10))
        points = pictures.link_points(states, rabbit())
        robot = rabbit()
        lengths = np.linalg.norm(np.diff(points[:, [0, 1, 2, 3]], axis=1), axis=2)
        expected = [robot.tibia_length, robot.femur_length, robot.torso_length]
        np.testing.assert_allclose(lengths, np.tile(expected, (50, 1)), rtol=1e-12)
        lengths = np.linalg.norm(np.diff(points[:, [2, 4, 5]], axis=1), axis=2)
        expected = [robot.femur_length, robot.tibia_length]
        np.testing.assert_allclose(lengths, np.tile(expected, (50, 1)), rtol=1e-12)

    def test_straight_robot(self):
        # Femurs and tibias hang straight down from an upright torso.
        state = np.array([[math.pi, math.pi, 0.0, 0.0, 0.0, *[0.0] * 5]])
        (points,) = pictures.link_points(state, rabbit())
        np.testing.assert_allclose(points[:, 0], 0.0, atol=1e-12)
        np.testing.assert_allclose(points[:, 1], [0.0, 0.4, 0.8, 1.43, 0.4, 0.0], atol=1e-12)

    def test_walk_on_the_flat_is_the_cycle(self, cycle):
        walk = pictures.walk(cycle.controller, cycle.state, [0.0] * 3, WalkerModel())
        assert walk.outcome is Outcome.STEP
        steps = np.diff(walk.feet, axis=0)
        # The state returns to itself up to the tolerance of the integrator.
        np.testing.assert_allclose(steps, [[cycle.step_length, 0.0]] * 3, atol=1e-6)
        # Figures at regular times, the time carried over from step to step, and one at the end.
        expected = math.ceil(3 * cycle.period / 0.085) + 1
        assert len(walk.points) == expected
        # Nobody is below the ground by more than the rounding of Table 1.
        assert walk.points[:, :, 1].min() > -1e-4

    def test_walk_ends_with_a_fall(self, cycle):
        walk = pictures.walk(cycle.controller, cycle.state, [0.0, SLOPE_LIMIT, 0.0], WalkerModel())
        assert walk.outcome is not Outcome.STEP
        assert walk.steps[-1] == 1

    def test_walk_that_falls_at_once(self, cycle):
        state = cycle.state.copy()
        state[0] = 0.0  # the stance leg points up
        walk = pictures.walk(cycle.controller, state, [0.0, 0.0], WalkerModel())
        assert walk.outcome is not Outcome.STEP
        assert len(walk.points) >= 1

    def test_example_is_always_the_same(self, cycle):
        first, second = (
            pictures.example_walk(cycle.controller, cycle.state, 0.0, 0.03, 5, WalkerModel())
            for _ in range(2)
        )
        np.testing.assert_array_equal(first.points, second.points)

    def test_picture_of_a_run(self, cycle, tmp_path):
        walk = pictures.walk(cycle.controller, cycle.state, [0.0, SLOPE_LIMIT], WalkerModel())
        sigma = np.linspace(0.5, 3.0, 5)
        mfpt = np.array([math.inf, 1e20, 1e4, 10.0, 2.0])
        path = tmp_path / "run.png"
        pictures.save_run(
            path, "title", walk, "walk", sigma, mfpt, [(1.0, 113.1, "mesh")], [(2.0, 6.0, 5.9, 6.1)]
        )
        assert path.read_bytes().startswith(b"\x89PNG")
        pictures.save_run(path, "title", walk, "walk", sigma, np.full(5, math.inf))

"""The command line: what scripts rely on, what users see when input is bad, and child processes."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from ros_graph import DOMAIN, PATIENCE, ros_graph
from test_resume import Gate, Gated

from biped_mfpt_ros.cli import main
from biped_mfpt_ros.cli.output import json_text
from biped_mfpt_ros.cli.parser import make_parser
from biped_mfpt_ros.cli.pipeline import Pipeline
from biped_mfpt_ros.cli.processes import Processes, Stopped
from biped_mfpt_ros.control.controller import controller, controller_names
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.walker.robot import WalkerModel

# On the limit cycle of hzd/base.
STATE = "3.61509750,3.03490073,-0.41620570,-0.319999,-0.01578744,0.37414059,-1.91681554,-3.56197438"
STATE += ",1.02274997,0.14075185"

COMMAND = [sys.executable, "-m", "biped_mfpt_ros.cli"]


def run_json(capsys, *arguments):
    assert main([*arguments, "--json", "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""

    def refuse(text):
        raise AssertionError(f"not JSON: {text}")

    return json.loads(captured.out, parse_constant=refuse)


def run_bad(capsys, *arguments):
    """Run with bad input; return the one line on stderr."""
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.splitlines()
    return line


class TestInProcess:
    def test_step(self, capsys):
        result = run_json(
            capsys, "step", "--controller", "hzd/base", "--state", STATE,
            "--previous-slope", "0", "--slope", "-2",
        )  # fmt: skip
        assert result["controller"] == "hzd/base"
        assert result["outcome"] == "step"
        assert result["outcome_code"] == 0
        assert result["slope"] == pytest.approx(math.radians(-2.0), rel=1e-15)
        assert len(result["next_state"]) == 10
        # A step downhill is longer than that of the cycle on the flat: 0.4135 m and 0.5168 s.
        assert 0.4135 < result["step_length"] < 0.5
        assert 0.5168 < result["duration"] < 0.7
        assert result["energy"] > 0.0

    def test_step_equals_the_core(self, capsys):
        from biped_mfpt_ros.gait.step import simulate_steps

        result = run_json(
            capsys, "step", "--controller", "hzd/base", "--state", STATE, "--slope", "-1e0",
            "--previous-slope", ".5", "--torque-limit", "none", "--friction", "0.7",
        )  # fmt: skip
        steps = simulate_steps(
            controller("hzd/base"),
            [[float(x) for x in STATE.split(",")]],
            [math.radians(0.5)],
            [math.radians(-1.0)],
            WalkerModel(torque_limit=math.inf, friction=0.7),
        )
        assert result["model"]["torque_limit"] == "inf"
        assert result["outcome_code"] == steps.outcomes[0, 0]
        assert result["duration"] == steps.durations[0, 0]
        np.testing.assert_array_equal(result["next_state"], steps.next_states[0])

    def test_step_that_falls(self, capsys):
        # The stance leg points up: the foot is nowhere near the ground.
        state = "-1e-3" + STATE[STATE.index(",") :]
        result = run_json(
            capsys, "step", "--controller", "hzd/base", "--state", state, "--previous-slope", "-.5"
        )
        assert result["previous_slope"] == pytest.approx(math.radians(-0.5), rel=1e-15)
        assert result["outcome"] != "step"
        assert result["outcome_code"] != 0
        assert result["next_state"] is None
        assert result["step_length"] == 0.0
        assert main(["step", "--controller", "hzd/base", "--state", state]) == 0
        assert result["outcome"].replace("_", " ") in capsys.readouterr().out

    def test_cycle(self, capsys):
        result = run_json(capsys, "cycle", "--controller", "hzd/base")
        # The paper's gait was designed for 0.8 m/s; its parameters are rounded to four digits.
        assert result["speed"] == pytest.approx(0.8, abs=5e-4)
        assert result["speed"] == pytest.approx(result["step_length"] / result["period"])
        assert len(result["state"]) == 10
        values = np.array([complex(re, im) for re, im in result["eigenvalues"]])
        np.testing.assert_allclose(np.abs(values), result["eigenvalue_magnitudes"], rtol=1e-12)
        assert result["stable"] is True
        assert result["eigenvalue_magnitudes"][0] < 1.0

    def test_state_of_cycle_is_read_by_step(self, capsys):
        assert main(["cycle", "--controller", "hzd/base"]) == 0
        (line,) = (x for x in capsys.readouterr().out.splitlines() if x.startswith("state "))
        result = run_json(capsys, "step", "--controller", "hzd/base", "--state", line.split()[1])
        # The printed state has nine digits.
        np.testing.assert_allclose(result["next_state"], result["state"], atol=1e-6)

    def test_no_cycle(self, capsys):
        code = main(["cycle", "--controller", "hzd/base", "--slope", "30", "--json"])
        captured = capsys.readouterr()
        assert code == 1
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        assert "no limit cycle of hzd/base" in line
        assert "30 degrees" in line

    def test_monte_carlo(self, capsys):
        arguments = ("monte-carlo", "--controller", "hzd/cot", "--sigma", "2", "--walks", "300")
        result = run_json(capsys, *arguments, "--seed", "1")
        assert result["walks"] == 300
        assert result["seed"] == 1
        assert result["sigma_s"] == pytest.approx(math.radians(2.0), rel=1e-15)
        assert result["paper"] == 2.2487
        low, high = result["confidence_interval"]
        assert low < result["mean_steps"] < high
        assert sum(result["failure_shares"].values()) == pytest.approx(1.0, abs=1e-12)
        again = run_json(capsys, *arguments, "--seed", "1")
        other = run_json(capsys, *arguments, "--seed", "2")
        assert again["mean_steps"] == result["mean_steps"] != other["mean_steps"]

    def test_monte_carlo_on_correlated_ground(self, capsys):
        arguments = ("monte-carlo", "--controller", "hzd/cot", "--sigma", "2", "--walks", "50")
        result = run_json(capsys, *arguments, "--correlation", "-0.5")
        expected = monte_carlo(controller("hzd/cot"), math.radians(2.0), 50, 1, correlation=-0.5)
        assert result["correlation"] == -0.5
        assert main([*arguments, "--mean", "1", "--correlation", "-0.5"]) == 0
        assert "; slopes with mean 1 deg, correlation -0.5\n" in capsys.readouterr().out
        assert main(arguments) == 0
        assert "slopes with" not in capsys.readouterr().out
        assert result["mean_steps"] == expected.mean_steps
        assert result["paper"] is None

    def test_monte_carlo_without_a_fall_gives_a_bound(self, capsys):
        arguments = ("monte-carlo", "--controller", "hzd/mfpt", "--sigma", "0.01", "--walks", "3")
        assert main([*arguments, "--max-steps", "10"]) == 0
        text = capsys.readouterr().out
        # 27 steps after the first ones: (1 - 1 / 9.0)^27 is about 5 %.
        assert text.startswith("hzd/mfpt: no fall; 95 % confidence: more than 9.0128 steps")
        assert "3 stopped after 10 steps" in text
        assert main([*arguments[:-3], "80", "--walks", "3"]) == 0
        assert "hzd/mfpt: all walks fell in the first step" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("arguments", "note"),
        [
            (["--sigma", "0.1"], "sigma 0.1 deg is finer than the slope set"),
            (["--sigma", "1", "--correlation", "0.9"], "at most 0.43589 deg"),
            (["--sigma", "5", "--slope-limit", "5"], "once in 3.1515 steps"),
            (["--sigma", "5", "--controller", "hzd/robust"], "once in 15787 steps"),
            (["--sigma", "1"], None),
        ],
    )
    def test_slope_sets_that_do_not_serve_a_sigma(self, capsys, arguments, note):
        arguments = ["mfpt", "--slope-step", "0.5", "--threshold", "0.3", *arguments]
        notes = run_json(capsys, *arguments)["notes"]
        assert (note in notes[0]) if note else notes == []
        assert main([*arguments, "--quiet"]) == 0
        assert "\n".join(notes) in capsys.readouterr().out

    def test_controllers(self, capsys):
        result = run_json(capsys, "controllers")
        names = [row["controller"] for row in result["controllers"]]
        paper = ["hzd/base", "hzd/cot", "hzd/mfpt", "smc/base", "smc/cot", "smc/mfpt"]
        assert names[:6] == paper
        assert sorted(names) == sorted(controller_names())
        assert result["controllers"][2]["mfpt"] == 113.1
        assert main(["controllers"]) == 0
        limits = "--torque-limit 120 --slip-duration 0.008 --friction-frame vertical"
        assert f"smc/cot     {limits}\n" in capsys.readouterr().out
        result = run_json(capsys, "cycle", "--controller", "smc/cot", *limits.split())
        assert result["stable"]


class TestBadInput:
    @pytest.mark.parametrize(
        ("arguments", "field", "value"),
        [
            (["step", "--state", "1,2,3"], "--state", "1,2,3"),
            (["step", "--state", STATE.replace("3.03490073", "nan")], "--state", "nan"),
            (["step", "--state", "-" + STATE, "--slope", "-60"], "--slope", "-60"),
            (["step", "--state", STATE, "--slope", "nan"], "--slope", "nan"),
            (["step", "--state", STATE, "--slope", "-x"], "--slope", None),
            (["step", "--state", STATE, "--previous-slope", "1e9"], "--previous-slope", "1000000"),
            (["step", "--state", STATE, "--controller", "hzd/none"], "--controller", "hzd/none"),
            (["step", "--state", STATE, "--torque-limit", "0"], "--torque-limit", "0.0"),
            (["step", "--state", STATE, "--friction", "nan"], "--friction", "nan"),
            (["step", "--state", STATE, "--slip-duration", "-1"], "--slip-duration", "-1"),
            (["step", "--state", STATE, "--time-limit", "0"], "--time-limit", "0.0"),
            (["step", "--state", STATE, "--tolerance", "1"], "--tolerance", "1"),
            (["step", "--state", "206,173,-23,-18,0,21,-90,-145,28,13"], "--state", "rad"),
            (["step"], "--state", None),
            (["cycle", "--controller", "hzd/cot", "--controller-file", "x"], "--controller", None),
            (["cycle", "--robot-file", "none.json"], "--robot-file", "none.json"),
            (["monte-carlo", "--sigma", "-2"], "--sigma", "-2"),
            (["monte-carlo", "--sigma", "inf"], "--sigma", "inf"),
            (["monte-carlo", "--sigma", "two"], "--sigma", "two"),
            (["monte-carlo", "--sigma", "2", "--correlation", "-1"], "--correlation", "-1.0"),
            (["mfpt", "--sigma", "1", "--correlation", "nan"], "--correlation", "nan"),
            (
                ["mfpt", "--sigma", "1", "--unclustered", "--correlation", "0.5"],
                "--correlation",
                "0.5",
            ),
            (["run", "--correlation", "1"], "--correlation", "1.0"),
            (["inspect", "bag", "--correlation", "0.5"], "--sigma", "missing"),
            (["optimise", "--local", "--correlation", "2"], "--correlation", "2.0"),
            (
                ["picture", "falls", "--output", "x.png", "--correlation", "1"],
                "--correlation",
                "1.0",
            ),
            (["monte-carlo", "--sigma", "2", "--walks", "0"], "--walks", "0"),
            (["monte-carlo", "--sigma", "2", "--walks", "1.5"], "--walks", "1.5"),
            (["monte-carlo", "--sigma", "2", "--seed", "-1"], "--seed", "-1"),
            (["monte-carlo", "--sigma", "2", "--mean", "-90"], "--mean", "-90"),
            (["monte-carlo", "--sigma", "2", "--max-steps", "0"], "--max-steps", "0"),
            (["mesh", "--threshold", "-0.1"], "--threshold", "-0.1"),
            (["mesh", "--slope-step", "0.3"], "--slope-step", "0.3"),
            (["mesh", "--slope-limit", "-20"], "--slope-limit", "-20"),
            (["mesh", "--max-states", "1"], "--max-states", "1"),
            (["mfpt"], "--sigma", None),
            (["mfpt", "--sigma"], "--sigma", None),
            (["mfpt", "--sigma", "1", "0"], "--sigma", "0.0"),
            (["mfpt", "--sigma", "1", "--mean", "nan"], "--mean", "nan"),
            (["mfpt", "--sigma", "1", "--mean", "-21"], "--mean", "-21"),
            (["mfpt", "--sigma", "1", "--mean", "6", "--slope-limit", "5"], "--mean", "6"),
            (["run", "--workers", "0"], "--workers", "0"),
            (["run", "--walks", "-1"], "--walks", "-1"),
            (["run", "--seed", "-1"], "--seed", "-1"),
            (["run", "--threshold", "0"], "--threshold", "0.0"),
            (["run", "--sigma", "1", "100"], "--sigma", "100"),
            (["run", "--mean", "50"], "--mean", "50"),
            (["run", "--namespace", "1st"], "--namespace", "1st"),
            (["run", "--output", "."], "--output", "."),
            (["inspect", "no/such/bag"], "BAG", "no/such/bag"),
            (["inspect", "bag", "--sigma", "-1"], "--sigma", "-1"),
            (["node", "nothing"], "NAME", "nothing"),
            (["node", "mesher", "--namespace", "x"], "argument", "--namespace"),
            (["reproduce", "--controllers", "hzd/none"], "--controllers", "hzd/none"),
            (["dance"], "COMMAND", "dance"),
            ([], "COMMAND", None),
            (["cycle", "--slop", "1"], "--slop", None),
        ],
    )
    def test_one_line_with_field_and_value(self, capsys, arguments, field, value):
        line = run_bad(capsys, *arguments)
        assert line.startswith("biped-mfpt")
        assert field in line
        if value is not None:
            assert value in line
            assert "allowed: " in line or "choose from" in line

    @pytest.mark.parametrize(
        ("change", "problem"),
        [
            ({"name": None}, "name: missing; allowed: an object with name, scheme and parameters"),
            ({"scheme": "hdz"}, "scheme: 'hdz' is not allowed; allowed: one of hzd"),
            ({"parameters": {}}, "parameters.alpha_0^1: missing; allowed: exactly kp, kd"),
            ({"parameters": {"a": 1.0}}, "parameters.a: 1.0 is not allowed; allowed: exactly kp"),
            ({"parameters": [1.0]}, "parameters: 'length 1' is not allowed"),
        ],
    )
    def test_controller_files(self, capsys, tmp_path, change, problem):
        path = tmp_path / "mine.json"
        values = {"name": "mine", "scheme": "hzd", "parameters": [1.0]} | change
        path.write_text(json.dumps({k: v for k, v in values.items() if v is not None}))
        assert f"{path}: {problem}" in run_bad(capsys, "cycle", "--controller-file", str(path))

    def test_missing_ros(self, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "rclpy", None)
        assert main(["node", "simulator"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert "rclpy" in line
        assert "make setup" in line
        assert "colcon build" in line

    def test_bug_keeps_its_traceback(self, monkeypatch):
        monkeypatch.setattr("biped_mfpt_ros.cli.single.catalogue", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            main(["controllers"])

    def test_interrupt(self, monkeypatch):
        def interrupt():
            raise KeyboardInterrupt

        monkeypatch.setattr("biped_mfpt_ros.cli.single.catalogue", interrupt)
        assert main(["controllers"]) == 130


def test_second_interrupt_does_not_wait_for_threads():
    # Says when the walks have begun. Blocks of them take hours here, and threads cannot be
    # interrupted.
    code = (
        "import sys\n"
        "from biped_mfpt_ros import cli\n"
        "from biped_mfpt_ros.gait import monte_carlo\n"
        "walk = monte_carlo._walk\n"
        "def tell(*args):\n"
        "    print('walking\\n', end='', flush=True)\n"  # in one piece, whoever prints beside
        "    walk(*args)\n"
        "monte_carlo._walk = tell\n"
        "sys.exit(cli.main())\n"
    )
    arguments = ["monte-carlo", "--controller", "smc/mfpt", "--sigma", "0.1", "--walks", "640"]
    arguments += ["--max-steps", "100000000"]
    command = [sys.executable, "-c", code, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "walking\n"
        deadline = time.monotonic() + PATIENCE
        # Two that come before the first is handled are one.
        while process.poll() is None:
            assert time.monotonic() < deadline
            process.send_signal(signal.SIGINT)
            time.sleep(0.1)
        assert process.returncode == 130


class TestHelp:
    def test_defaults_in_the_text_are_those_of_the_core(self):
        parser = make_parser().parse_args(["cycle"]).parser
        texts = {action.dest: action.help for action in parser._actions}
        defaults = WalkerModel()
        for option in ("torque_limit", "friction", "slip_duration", "time_limit", "tolerance"):
            shown = texts[option].partition("(default: ")[2].rstrip(")")
            assert float(shown) == getattr(defaults, option), option
        shown = texts["friction_frame"].partition("(default: ")[2].rstrip(")")
        assert shown == defaults.friction_frame

    def test_is_quick_because_nothing_heavy_is_imported(self):
        # Time itself depends on the machine; what costs time is importing these.
        code = (
            "import sys; from biped_mfpt_ros.cli import main; main(['--help']);"
            "main(['mfpt', '--help']);"
            "print([m for m in ('numpy', 'numba', 'scipy', 'rclpy', 'matplotlib') "
            "if m in sys.modules])"
        )
        out = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout
        assert out.splitlines()[-1] == "[]"

    def test_state_limit_in_the_text_is_that_of_the_core(self):
        from biped_mfpt_ros.chain.mesh import DEFAULT_MAX_STATES

        parser = make_parser().parse_args(["mesh"]).parser
        (text,) = (a.help for a in parser._actions if a.dest == "max_states")
        assert f"(default: {DEFAULT_MAX_STATES})" in text

    @pytest.mark.parametrize(
        "name", ["run", "mfpt", "mesh", "monte-carlo", "cycle", "step", "inspect"]
    )
    def test_every_example_is_accepted(self, name):
        parser = make_parser()
        epilog = parser.parse_args([name, *_required(name)]).parser.epilog
        examples = epilog.replace("\\\n", " ").splitlines()[1:]
        assert examples
        for example in examples:
            program, *arguments = example.split()
            assert program == "biped-mfpt"
            assert parser.parse_args(arguments).command == name


def _required(name):
    return {
        "mfpt": ["--sigma", "1"],
        "monte-carlo": ["--sigma", "1"],
        "step": ["--state", STATE],
        "inspect": ["bag"],
    }.get(name, [])


class TestMesh:
    ARGUMENTS = ("--controller", "hzd/cot", "--slope-step", "0.5", "--threshold", "0.3")

    def test_mfpt(self, capsys):
        result = run_json(capsys, "mfpt", *self.ARGUMENTS, "--sigma", "1", "2")
        assert [row["sigma_s_deg"] for row in result["estimates"]] == [1.0, 2.0]
        one, two = result["estimates"]
        assert one["mfpt"] > two["mfpt"] > 1.0
        for row in (one, two):
            assert row["sigma_s"] == pytest.approx(math.radians(row["sigma_s_deg"]), rel=1e-15)
            assert row["mfpt"] == pytest.approx(1.0 / row["failure_probability"], rel=1e-15)
            assert sum(row["failure_shares"].values()) == pytest.approx(1.0, abs=1e-12)
        assert (one["paper"], two["paper"]) == (7.3, 2.2049)
        assert result["swings"] == result["states"] - 1  # none from the failure state
        assert result["slopes"] == 81

    def test_equals_the_core(self, capsys):
        from biped_mfpt_ros.chain.markov import metastability
        from biped_mfpt_ros.chain.mesh import grow_mesh
        from biped_mfpt_ros.gait.cycle import find_limit_cycle
        from biped_mfpt_ros.gait.step import simulate_steps
        from biped_mfpt_ros.walker.terrain import slope_set

        result = run_json(
            capsys, "mfpt", *self.ARGUMENTS, "--sigma", "1.5", "--mean", "-0.5",
            "--unclustered", "--friction", "0.7", "--friction-frame", "vertical",
            "--scale-refresh", "addition",
        )  # fmt: skip
        walking, slopes = controller("hzd/cot"), slope_set(0.5)
        model = WalkerModel(friction=0.7, friction_frame="vertical")
        mesh = grow_mesh(
            lambda states, previous: simulate_steps(walking, states, previous, slopes, model),
            find_limit_cycle(walking, model=model).state,
            slopes,
            0.3,
            clustered=False,
            scale_refresh="addition",
        )
        expected = metastability(mesh, math.radians(-0.5), math.radians(1.5))
        assert result["states"] == len(mesh.states)
        assert result["estimates"][0]["mfpt"] == expected.mfpt

    def test_correlated_ground(self, capsys):
        from biped_mfpt_ros.chain.markov import metastability
        from biped_mfpt_ros.chain.mesh import grow_mesh
        from biped_mfpt_ros.gait.cycle import find_limit_cycle
        from biped_mfpt_ros.gait.step import simulate_steps
        from biped_mfpt_ros.walker.terrain import slope_set

        result = run_json(
            capsys,
            "mfpt",
            *self.ARGUMENTS,
            "--sigma",
            "1",
            "--mean",
            "-0.5",
            "--correlation",
            "0.6",
        )
        walking, slopes = controller("hzd/cot"), slope_set(0.5)
        mesh = grow_mesh(
            lambda states, previous: simulate_steps(walking, states, previous, slopes),
            find_limit_cycle(walking).state, slopes, 0.3,
        )  # fmt: skip
        expected = metastability(mesh, math.radians(-0.5), math.radians(1.0), 0.6)
        assert result["correlation"] == 0.6
        assert result["estimates"][0]["mfpt"] == expected.mfpt
        assert result["estimates"][0]["paper"] is None

    def test_mesh_in_a_file(self, capsys, tmp_path):
        path = tmp_path / "mesh.of.cot"
        result = run_json(capsys, "mesh", *self.ARGUMENTS, "--output", str(path))
        with np.load(path) as arrays:
            assert arrays["states"].shape == (result["states"], 10)
            assert arrays["targets"].shape == (result["states"], 81)
            assert float(arrays["threshold"]) == 0.3
        line = run_bad(capsys, "mesh", *self.ARGUMENTS, "--output", str(path))
        assert "--output" in line
        assert str(path) in line

    def test_limit_on_states(self, capsys):
        assert main(["mesh", *self.ARGUMENTS, "--max-states", "5", "--quiet"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert "max_states = 5" in line


def test_json_text():
    value = {
        "a": np.array([1.0, math.inf, -math.inf, math.nan]),
        "b": (np.float64(0.1), np.int64(3), 1j),
        "c": {"d": True, "e": None, "f": "text"},
    }
    assert json.loads(json_text(value)) == {
        "a": [1.0, "inf", "-inf", None],
        "b": [0.1, 3, [0.0, 1.0]],
        "c": {"d": True, "e": None, "f": "text"},
    }


# A child that ends on SIGTERM, one that does not, and a program that starts one and waits.
SLEEP = [sys.executable, "-c", "import time; print('up', flush=True); time.sleep(3600)"]
STUBBORN = [
    sys.executable,
    "-c",
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
    "print('up', flush=True); time.sleep(3600)",
]


def wait_until_up(child):
    deadline = time.monotonic() + PATIENCE
    while "up" not in child.log.read_text():
        assert time.monotonic() < deadline, "the child does not start"
        time.sleep(0.01)


def alive(pid):
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class TestProcesses:
    @pytest.fixture(autouse=True)
    def signals_as_in_a_terminal(self):
        """In the background a shell ignores SIGINT, and nohup SIGHUP: children inherit that."""
        usual = {
            signal.SIGINT: signal.default_int_handler,
            signal.SIGTERM: signal.SIG_DFL,
            signal.SIGHUP: signal.SIG_DFL,
        }
        before = {number: signal.signal(number, handler) for number, handler in usual.items()}
        yield
        for number, handler in before.items():
            signal.signal(number, handler)

    def test_stops_in_order(self, tmp_path, monkeypatch):
        for grace in ("_GRACE", "_LAST_GRACE"):
            monkeypatch.setattr(f"biped_mfpt_ros.cli.processes.{grace}", PATIENCE)
        script = (
            "import pathlib, signal, sys, time\n"
            "def end(*_):\n"
            "    with open(sys.argv[1], 'a') as f: f.write(sys.argv[2] + '\\n')\n"
            "    sys.exit(0)\n"
            "signal.signal(signal.SIGTERM, end)\n"
            "print('up', flush=True)\n"
            "time.sleep(3600)\n"
        )
        order = tmp_path / "order"
        with Processes(tmp_path / "logs") as processes:
            for name, last in (("recorder", True), ("one", False), ("two", False)):
                command = [sys.executable, "-c", script, str(order), name]
                wait_until_up(processes.start(name, command, last=last))
            assert [child.name for child in processes.running()] == ["recorder", "one", "two"]
        names = order.read_text().split()
        assert sorted(names[:2]) == ["one", "two"]
        assert names[2:] == ["recorder"]
        assert processes.running() == []

    def test_kills_what_does_not_end(self, tmp_path):
        with Processes(tmp_path) as processes:
            child = processes.start("stubborn", STUBBORN)
            wait_until_up(child)
        assert child.process.returncode == -signal.SIGKILL
        assert child.ending() == "was killed by SIGKILL"

    @pytest.mark.parametrize("told", [None, PATIENCE])
    def test_the_last_one_has_longer(self, tmp_path, monkeypatch, told):
        """A recorder that closes its bag on a busy machine."""
        monkeypatch.setattr("biped_mfpt_ros.cli.processes._GRACE", 0.1)
        monkeypatch.setattr("biped_mfpt_ros.cli.processes._LAST_GRACE", 0.1 if told else PATIENCE)
        slow = (
            "import signal, sys, time\n"
            "def end(*_):\n"
            "    time.sleep(0.5)\n"
            "    sys.exit(0)\n"
            "signal.signal(signal.SIGTERM, end)\n"
            "print('up', flush=True)\n"
            "time.sleep(3600)\n"
        )
        with Processes(tmp_path) as processes:
            last = processes.start("slow", [sys.executable, "-c", slow], last=True)
            wait_until_up(last)
            processes.stop(told)
        assert last.ending() == "ended with code 0"

    def test_early_end_is_reported_once_with_the_log(self, tmp_path):
        with Processes(tmp_path) as processes:
            command = [sys.executable, "-c", "print('last words'); raise SystemExit(3)"]
            child = processes.start("short", command)
            other = processes.start("long", SLEEP)
            child.process.wait(PATIENCE)
            assert processes.newly_ended() == [child]
            assert processes.newly_ended() == []
            assert child.ending() == "ended with code 3"
            assert child.log_tail() == "last words"
            assert processes.running() == [other]

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
    def test_signal_raises_and_children_end(self, tmp_path, number):
        handler = signal.getsignal(number)
        processes = Processes(tmp_path)

        def run():
            with processes:
                wait_until_up(processes.start("child", SLEEP))
                assert len(processes.running()) == 1
                os.kill(os.getpid(), number)
                time.sleep(20)

        with pytest.raises(Stopped):
            run()
        assert processes.running() == []
        assert signal.getsignal(number) is handler

    @pytest.mark.parametrize("last", [False, True])
    def test_second_signal_does_not_wait(self, tmp_path, monkeypatch, last):
        for grace in ("_GRACE", "_LAST_GRACE"):
            monkeypatch.setattr(f"biped_mfpt_ros.cli.processes.{grace}", 2.0 * PATIENCE)
        # One that does not end; that it is asked to brings the second signal.
        code = (
            "import os, signal, time\n"
            f"signal.signal(signal.SIGTERM, lambda *_: os.kill({os.getpid()}, signal.SIGINT))\n"
            "print('up', flush=True)\n"
            "while True: time.sleep(3600)\n"
        )
        processes = Processes(tmp_path)

        def run():
            with processes:
                stubborn.append(processes.start("s", [sys.executable, "-c", code], last=last))
                wait_until_up(stubborn[0])
                start.append(time.monotonic())
                os.kill(os.getpid(), signal.SIGINT)

        start, stubborn = [], []
        with pytest.raises(Stopped):
            run()
        assert time.monotonic() - start[0] < PATIENCE
        assert stubborn[0].ending() == "was killed by SIGKILL"

    def test_children_end_with_a_killed_parent(self, tmp_path):
        child = (
            "import sys, time\n"
            "from biped_mfpt_ros.cli.node import end_with\n"
            "end_with(int(sys.argv[1]))\n"
            "print('up', flush=True)\n"
            "time.sleep(3600)\n"
        )
        parent = (
            "import os, pathlib, sys, time\n"
            "from biped_mfpt_ros.cli.processes import Processes\n"
            "with Processes(pathlib.Path(sys.argv[1])) as processes:\n"
            f"    command = [sys.executable, '-c', {child!r}, str(os.getpid())]\n"
            "    child = processes.start('child', command)\n"
            "    while 'up' not in child.log.read_text(): time.sleep(0.01)\n"
            "    print(child.process.pid, flush=True)\n"
            "    time.sleep(3600)\n"
        )
        command = [sys.executable, "-c", parent, str(tmp_path)]
        with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
            pid = int(process.stdout.readline())
            assert alive(pid)
            process.kill()
        deadline = time.monotonic() + PATIENCE
        while alive(pid):
            assert time.monotonic() < deadline, "the child outlives its parent"
            time.sleep(0.01)

    def test_end_with_a_parent_that_is_gone(self):
        from biped_mfpt_ros.cli.node import end_with

        with pytest.raises(SystemExit):
            end_with(os.getppid() + 1)


class Run:
    """`biped-mfpt run` as a process, in a directory of its own."""

    def __init__(self, directory, *arguments):
        self.directory = directory
        self.process = subprocess.Popen(
            [*COMMAND, "run", "--controller", "hzd/cot", *arguments],
            cwd=directory,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # The package is imported from where the tests import it.
            env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])},
        )

    def nodes(self):
        """Process ids of the nodes that are running, by what they are."""
        found = {}
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                words = path.read_bytes().decode().split("\0")
            except OSError:
                continue
            if "--end-with" in words and str(self.process.pid) in words:
                name = words[words.index(str(self.process.pid)) + 1]
                found.setdefault(name, []).append(int(path.parent.name))
        return found

    def wait_for_nodes(self):
        wait_until(lambda: sum(map(len, self.nodes().values())) == 5, self, "five nodes")

    def wait_for_mesh(self):
        """Wait until a mesh is being recorded."""
        bag = self.directory / "run" / "bag"
        wait_until(
            lambda: any(path.stat().st_size > 10_000 for path in bag.glob("*.mcap")), self, "a bag"
        )

    def end(self, timeout=PATIENCE):
        try:
            out, err = self.process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            self.process.kill()
            pytest.fail(f"still running after {timeout} s: {self.process.communicate()}")
        return self.process.returncode, out, err


def wait_until(condition, run, what, timeout=PATIENCE):
    deadline = time.monotonic() + timeout
    while not condition():
        if run.process.poll() is not None:
            pytest.fail(f"ended while waiting for {what}: {run.process.communicate()}")
        if time.monotonic() > deadline:
            run.process.kill()
            pytest.fail(f"waited {timeout} s for {what}: {run.process.communicate()}")
        time.sleep(0.05)


# A mesh that is never complete.
LONG = (
    "--slope-step", "0.25", "--threshold", "1e-6", "--max-states", "100000000",
    "--workers", "1", "--output", "run",
)  # fmt: skip


def run_checkpoint(run):
    """Where a run keeps the answers of the mesh that it grows."""
    return Path(tempfile.gettempdir(), f"biped-mfpt-run-{run.process.pid}")


class TestRun:
    def test_result_is_that_of_one_process_although_a_simulator_dies(self, tmp_path, capsys):
        arguments = ("--threshold", "0.3", "--sigma", "1", "2")
        more = ("--workers", "2", "--walks", "50", "--json", "--output", "run")
        run = Run(tmp_path, *arguments, *more)
        run.wait_for_nodes()
        os.kill(run.nodes()["simulator"][0], signal.SIGKILL)
        code, out, err = run.end()
        assert code == 0, err
        assert "was killed by SIGKILL" in err
        assert "going on with 1 simulator" in err
        assert run.nodes() == {}
        result = json.loads(out)
        alone = run_json(capsys, "mfpt", "--controller", "hzd/cot", *arguments)
        assert result["states"] == alone["states"]
        assert result["estimates"] == alone["estimates"]
        assert [point["sigma_s"] for point in result["curve"]] == sorted(
            point["sigma_s"] for point in result["curve"]
        )
        assert {row["walks"] for row in result["monte_carlo"]} == {50}
        assert json.loads((tmp_path / "run" / "result.json").read_text()) == result
        assert (tmp_path / "run" / "mfpt.png").read_bytes().startswith(b"\x89PNG")
        inspected = run_json(capsys, "inspect", str(tmp_path / "run" / "bag"))
        assert inspected["problems"] == []
        (mesh,) = inspected["meshes"]
        assert [row["mfpt"] for row in mesh["estimates"]] == [
            row["mfpt"] for row in alone["estimates"]
        ]
        # What tells a run that its bag has all of it.
        pipeline = Pipeline(None, None, result["namespace"])
        (tmp_path / "run" / "growing").mkdir()
        data = (tmp_path / "run" / "bag" / "bag_0.mcap").read_bytes()
        (tmp_path / "run" / "growing" / "growing_0.mcap").write_bytes(data[:-8])
        for bag, mesh_id, estimates, there in (
            ("growing", result["mesh_id"], 2, True),
            ("growing", result["mesh_id"], 3, False),
            ("growing", "another", 2, False),
            ("none", result["mesh_id"], 0, False),
        ):
            pipeline._bag = tmp_path / "run" / bag
            assert pipeline._recorded(mesh_id, estimates) == there
        assert main(["inspect", str(tmp_path / "run")]) == 0
        assert repr(mesh["estimates"][0]["mfpt"]) in capsys.readouterr().out

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_signal_stops_everything_and_closes_the_bag(self, tmp_path, number):
        run = Run(tmp_path, *LONG)
        run.wait_for_mesh()
        run.process.send_signal(number)
        code, _, err = run.end()
        assert code == 130, err
        assert run.nodes() == {}
        assert (tmp_path / "run" / "bag" / "metadata.yaml").exists()

    def test_nodes_end_with_a_killed_parent(self, tmp_path):
        run = Run(tmp_path, *LONG)
        run.wait_for_mesh()
        run.process.kill()
        start = time.monotonic()
        while run.nodes():
            assert time.monotonic() - start < PATIENCE, run.nodes()
            time.sleep(0.05)
        run.end()
        assert (tmp_path / "run" / "bag" / "metadata.yaml").exists()

    def test_a_node_that_dies_ends_the_run_with_its_log(self, tmp_path):
        run = Run(tmp_path, *LONG)
        run.wait_for_mesh()
        os.kill(run.nodes()["analysis"][0], signal.SIGKILL)
        code, _, err = run.end()
        assert code == 1
        assert "analysis was killed by SIGKILL; the end of run/logs/analysis.log:" in err
        assert "ready" in err.partition("analysis.log:")[2]
        assert run.nodes() == {}
        assert not run_checkpoint(run).exists()

    def test_a_mesher_that_is_killed_is_replaced_and_the_mesh_goes_on(self, tmp_path, capsys):
        arguments = ("--threshold", "0.002", "--sigma", "2")
        more = ("--workers", "1", "--walks", "0", "--json", "--output", "run")
        with ros_graph() as graph, pytest.MonkeyPatch.context() as patch:
            patch.setenv("ROS_DOMAIN_ID", str(DOMAIN))
            run = Run(tmp_path, *arguments, *more, "--namespace", "killed")
            # In the place of its own simulator, and held before the mesh is complete.
            wait_until(lambda: "simulator" in run.nodes(), run, "its simulator")
            os.kill(run.nodes()["simulator"][0], signal.SIGSTOP)
            gate = Gate()
            gate.hold_after(50)
            graph.start(lambda: Gated(gate, "killed_simulator", namespace="/killed"))
            kept = run_checkpoint(run)
            wait_until(
                lambda: any(path.stat().st_size > 20_000 for path in kept.glob("*.journal")),
                run,
                "the mesh to grow",
            )
            os.kill(run.nodes()["mesher"][0], signal.SIGKILL)
            gate.release()
            code, out, err = run.end()
        assert code == 0, err
        assert "starting another one, which goes on where it was" in err
        result = json.loads(out)
        assert 0 < result["swings_resumed"] == result["states"] - 1 - result["swings"]
        alone = run_json(capsys, "mfpt", "--controller", "hzd/cot", *arguments)
        assert result["states"] == alone["states"]
        assert result["estimates"] == alone["estimates"]
        assert not kept.exists()

    @pytest.mark.slow
    def test_runs_side_by_side_do_not_mix(self, tmp_path, capsys):
        arguments = ("--threshold", "0.3", "--walks", "0", "--json", "--output", "run")
        runs = []
        for name in ("one", "two"):
            (tmp_path / name).mkdir()
            runs.append(Run(tmp_path / name, *arguments, "--workers", "1"))
        for run in runs:
            code, out, err = run.end()
            assert code == 0, err
            namespace = json.loads(out)["namespace"]
            inspected = run_json(capsys, "inspect", str(run.directory / "run" / "bag"))
            assert inspected["problems"] == []
            assert len(inspected["meshes"]) == 1
            assert {t["name"].rpartition(namespace + "/")[0] for t in inspected["topics"]} == {""}
            log = (run.directory / "run" / "logs" / "mesher.log").read_text()
            assert json.loads(out)["mesh_id"] in log

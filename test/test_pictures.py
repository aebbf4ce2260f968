"""Pictures of walks and meshes: they show what they were given, for every kind of walk and mesh."""

from __future__ import annotations

import io
import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from biped_mfpt_ros.chain.markov import (
    conditional_probabilities,
    metastability,
    slope_probabilities,
)
from biped_mfpt_ros.chain.mesh import NOT_SIMULATED, Mesh, grow_mesh
from biped_mfpt_ros.cli import main
from biped_mfpt_ros.control.controller import controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.gait.cycle import find_limit_cycle
from biped_mfpt_ros.gait.monte_carlo import monte_carlo
from biped_mfpt_ros.gait.step import simulate_steps
from biped_mfpt_ros.gait.trace import trace_swing
from biped_mfpt_ros.report import gaits, mesh_pictures, pictures, style
from biped_mfpt_ros.walker.outcome import Outcome
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit
from biped_mfpt_ros.walker.terrain import slope_set

HZD = controller("hzd/mfpt")
SIGMA = math.radians(2.0)
NAME = "hzd/mfpt"


@pytest.fixture(scope="module")
def cycle():
    return find_limit_cycle(HZD)


@pytest.fixture(scope="module")
def walk(cycle):
    return gaits.rough_walk(HZD, SIGMA, seed=1, last_steps=3, state=cycle.state)


@pytest.fixture(scope="module")
def first_step_fall(cycle):
    """A walk that ends before anything has moved: the stance leg points up."""
    state = cycle.state.copy()
    state[0] = 0.0
    return gaits.rough_walk(HZD, SIGMA, state=state)


@pytest.fixture(scope="module")
def mesh(cycle):
    slopes = slope_set(1.0, 6.0)
    return grow_mesh(
        lambda states, previous: simulate_steps(HZD, states, previous, slopes),
        cycle.state, slopes, 0.5,
    )  # fmt: skip


@pytest.fixture(scope="module")
def found(mesh):
    return metastability(mesh, 0.0, SIGMA)


def small_mesh(outcomes, states=((0.0,) * 10, (1.0,) * 10), scales=(1.0,) * 10):
    """A mesh of given states in which every step that succeeds leads to state 1."""
    outcomes = np.array([[NOT_SIMULATED] * len(outcomes[0]), *outcomes])
    n, m = outcomes.shape
    return Mesh(
        slopes=np.radians(np.arange(m) - m // 2),
        states=np.array(states),
        preceding=np.zeros(n),
        generation=np.zeros(n),
        targets=np.where(outcomes == Outcome.STEP, 1, 0),
        outcomes=outcomes,
        scales=np.array(scales),
        threshold=0.3,
        clustered=True,
    )


@pytest.fixture
def drawn(monkeypatch):
    """Figures that are drawn, instead of their files."""
    figures = []

    def keep(figure):
        figures.append(figure)
        return b""

    for module in (gaits, mesh_pictures):
        monkeypatch.setattr(module, "png", keep)
    return figures


def opened(picture):
    """The image of a picture, checked for what every picture promises."""
    image = Image.open(io.BytesIO(picture.data))
    assert picture.mime == Image.MIME[image.format]
    assert len(picture.data) < 600_000
    assert picture.title
    assert picture.caption.endswith(".")
    image.load()
    return image


def offsets(axes):
    return [np.asarray(points.get_offsets()) for points in axes.collections]


class TestRoughWalk:
    @pytest.mark.parametrize("ground", [{}, {"mu_s": 0.004, "correlation": -0.6}])
    def test_is_a_walk_of_monte_carlo(self, cycle, ground):
        expected = monte_carlo(HZD, SIGMA, 6, 5, **ground, state=cycle.state, threads=1)
        for number in range(6):
            found = gaits.rough_walk(HZD, SIGMA, seed=5, number=number, **ground, state=cycle.state)
            assert found.steps == expected.steps[number]
            assert found.outcome == expected.outcomes[number]

    def test_swings_follow_each_other(self, walk):
        assert len(walk.swings) == len(walk.starts) == len(walk.slopes) - 1 == 3
        assert walk.first == walk.steps - 2
        for swing, following in zip(walk.swings[:-1], walk.starts[1:], strict=True):
            np.testing.assert_array_equal(swing.next_state, following)
        assert walk.swings[-1].next_state is None

    def test_short_walk_is_kept_whole(self, cycle, walk):
        whole = gaits.rough_walk(HZD, SIGMA, seed=1, last_steps=10_000, state=cycle.state)
        assert len(whole.swings) == whole.steps == walk.steps
        assert whole.first == 1
        assert whole.slopes[0] == 0.0
        np.testing.assert_array_equal(whole.starts[-3:], walk.starts)

    def test_walk_that_is_stopped(self, cycle):
        found = gaits.rough_walk(HZD, 1e-3, max_steps=2, state=cycle.state)
        assert (found.steps, found.outcome) == (2, Outcome.STEP)
        assert "still upright" in gaits.gait(found).caption

    @pytest.mark.parametrize(
        ("field", "value"),
        [("sigma_s", 0.0), ("mu_s", 1.0), ("seed", -1), ("number", -1), ("last_steps", 0),
         ("max_steps", 0)],
    )  # fmt: skip
    def test_bad_input(self, cycle, field, value):
        settings = {"sigma_s": SIGMA, "state": cycle.state, field: value}
        with pytest.raises(InputError, match=field):
            gaits.rough_walk(HZD, **settings)


class TestFigures:
    def test_last_figure_is_the_moment_of_the_fall(self, walk):
        walking = walk.figures(gaits.FRAME_INTERVAL)
        (points,) = pictures.link_points(walk.swings[-1].states[-1:], rabbit())
        np.testing.assert_allclose(walking.points[-1], points + walking.feet[2], atol=1e-12)
        np.testing.assert_array_equal(walking.forces[-1], walk.swings[-1].forces[-1])
        np.testing.assert_array_equal(walking.slopes, walk.slopes)
        assert walking.outcome is walk.outcome

    @pytest.mark.parametrize(
        ("outcome", "point"),
        [
            (Outcome.STANCE_SLIPS, 0),
            (Outcome.STANCE_LIFTS, 0),
            (Outcome.NO_LIFT_OFF, 0),
            (Outcome.SWING_SCUFFS, 5),
            (Outcome.IMPACT_SLIPS, 5),
            (Outcome.BODY_TOUCHES, 4),
        ],
    )
    def test_the_part_that_fails_is_marked(self, walk, outcome, point):
        walking = replace(walk.figures(0.1), outcome=outcome)
        walking.points[-1, 4, 1] = -5.0  # the swing knee is deep below the ground
        np.testing.assert_array_equal(pictures.where_it_falls(walking), walking.points[-1, point])


class TestWalkPictures:
    def test_gait(self, walk):
        picture = gaits.gait(walk)
        assert opened(picture).size[0] == round(style.WIDTH * style.DPI)
        assert f"Steps {walk.first} to {walk.steps}" in picture.caption
        assert "walk 0 of seed 1" in picture.caption
        assert walk.outcome.label in picture.caption

    def test_slopes_are_written_under_the_steps(self, walk, drawn):
        gaits.gait(walk)
        (axes,) = drawn[0].axes
        texts = [text.get_text().replace("−", "-") for text in axes.texts]
        expected = [f"{slope:+.1f}°" for slope in np.degrees(walk.slopes[1:])]
        assert texts == expected
        assert axes.get_title("right") == walk.outcome.label

    def test_animation(self, walk):
        picture = gaits.animation(walk)
        image = opened(picture)
        frames = len(walk.figures(gaits.FRAME_INTERVAL).points)
        assert image.n_frames == frames
        assert image.info["loop"] == 0  # for ever
        durations = []
        for frame in range(frames):
            image.seek(frame)
            durations.append(image.info["duration"])
        assert durations == [50] * (frames - 1) + [2000]
        assert image.convert("RGB").getpixel((image.width - 1, 0)) == (255, 255, 255)
        assert walk.outcome.label in picture.caption

    def test_phase_portraits(self, walk, cycle, drawn):
        gaits.phase_portraits(walk, cycle)
        panels = drawn[0].axes[:5]
        flat = trace_swing(HZD, cycle.state, 0.0, 0.0, walk.model)
        for i, axes in enumerate(panels):
            (curves,) = axes.collections
            for drawn_curve, swing in zip(curves.get_segments(), walk.swings, strict=True):
                np.testing.assert_array_equal(drawn_curve, swing.states[:, [i, 5 + i]])
            lines = [np.array(line.get_data()).T for line in axes.lines]
            # Starts of the swings, the fall, then the cycle on top of all.
            # To the rounding of absolute angles and back.
            np.testing.assert_allclose(
                np.concatenate(lines[:3]), walk.starts[:, [i, 5 + i]], rtol=0, atol=1e-15
            )
            np.testing.assert_array_equal(lines[3][0], walk.swings[-1].states[-1, [i, 5 + i]])
            np.testing.assert_array_equal(lines[4], flat.states[:, [i, 5 + i]])
            assert axes.lines[4].get_zorder() > curves.get_zorder()
            assert "rad" in axes.get_xlabel()
            assert "rad/s" in axes.get_ylabel()

    def test_torques(self, walk):
        axes = Figure().subplots()
        gaits.draw_torques(axes, walk.swings[-1], 50.0)
        for i, line in enumerate(axes.lines[:4]):
            np.testing.assert_array_equal(line.get_xdata(), walk.swings[-1].times)
            np.testing.assert_array_equal(line.get_ydata(), walk.swings[-1].torques[:, i])
        assert [line.get_ydata()[0] for line in axes.lines[4:]] == [50.0, -50.0]

    def test_no_limits_are_drawn_where_there_are_none(self, walk):
        figure = Figure()
        upper, lower = figure.subplots(2)
        gaits.draw_torques(upper, walk.swings[0], math.inf)
        gaits.draw_force_ratio(lower, walk.swings[0], WalkerModel(friction=math.inf))
        assert (len(upper.lines), len(lower.lines)) == (4, 1)

    def test_ground_forces(self, walk):
        swing = walk.swings[-1]
        assert swing.outcome is Outcome.STANCE_SLIPS  # of this seed
        axes = Figure().subplots()
        gaits.draw_force_ratio(axes, swing, walk.model)
        ratio, friction, fall = (line.get_ydata() for line in axes.lines)
        np.testing.assert_array_equal(ratio, np.abs(swing.forces[:, 0] / swing.forces[:, 1]))
        assert friction[0] == walk.model.friction
        # The swing ends where it slips: the ratio there is the friction, to the root's accuracy.
        assert fall[0] == pytest.approx(walk.model.friction, rel=1e-6)
        assert axes.get_ylim()[1] > walk.model.friction

    def test_a_foot_that_bears_nothing_has_no_ratio(self, walk):
        swing = replace(walk.swings[0], forces=np.array([[1.0, 0.0], [1.0, -1.0], [-60.0, 120.0]]))
        np.testing.assert_array_equal(
            gaits.force_ratio(swing, walk.model), [math.nan, math.nan, 0.5]
        )

    def test_torques_and_forces(self, walk):
        picture = gaits.torques({"one": walk.swings[0], "two": walk.swings[-1]}, walk.model, NAME)
        opened(picture)
        assert "50 N m" in picture.caption

    def test_fall_at_the_very_start(self, first_step_fall, cycle):
        walk = first_step_fall
        assert walk.steps == 1
        assert walk.swings[0].times.size == 0
        assert "The only step" in gaits.gait(walk).caption
        assert opened(gaits.animation(walk)).n_frames == 1
        opened(gaits.phase_portraits(walk, cycle))
        opened(gaits.torques({"fall": walk.swings[0]}, walk.model, NAME))


class TestMeshPictures:
    def test_plane_of_states_on_a_plane(self):
        random = np.random.default_rng(1)
        scales = np.array([*random.uniform(0.1, 10.0, 9), math.inf])
        basis = np.linalg.qr(random.standard_normal((9, 2)))[0]
        weights = random.standard_normal((50, 2)) * [3.0, 1.0]
        states = np.zeros((51, 10))
        states[1:, :9] = weights @ basis.T * scales[:9] + 5.0
        states[1:, 9] = random.standard_normal(50)  # does not count
        plane = mesh_pictures.principal_plane(small_mesh([[0]] * 50, states, scales))
        assert plane.shares[:2].sum() == pytest.approx(1.0, rel=1e-12)
        np.testing.assert_allclose(plane.directions @ plane.directions.T, np.eye(10), atol=1e-12)
        # Distances are those of the standardised states.
        centred = weights - weights.mean(axis=0)
        np.testing.assert_allclose(
            np.linalg.norm(plane.scores[:, :2], axis=1), np.linalg.norm(centred, axis=1), rtol=1e-9
        )

    def test_mesh(self, mesh, drawn):
        caption = mesh_pictures.mesh_plane(mesh, NAME).caption
        plane = mesh_pictures.principal_plane(mesh)
        axes = drawn[0].axes[0]
        (points,) = offsets(axes)
        colours = axes.collections[0].get_array()
        expected = np.column_stack(
            [plane.scores[:, :2], np.degrees(mesh.slopes[mesh.preceding[1:]])]
        )
        shown = np.column_stack([points, colours])
        np.testing.assert_array_equal(shown[np.lexsort(shown.T)], expected[np.lexsort(expected.T)])
        np.testing.assert_array_equal(
            np.ravel(axes.lines[0].get_data()), plane.scores[0, :2]
        )  # fmt: skip
        assert f"{plane.shares[:2].sum():.1%} of the variance" in caption
        assert f"{len(mesh.states) - 1} states" in caption

    def test_distribution(self, mesh, found, drawn):
        mesh_pictures.mesh_distribution(mesh, found, 0.0, SIGMA, NAME)
        axes = drawn[0].axes[0]
        faint, seen = offsets(axes)
        weights = found.distribution[1:]
        assert len(faint) == np.count_nonzero(weights < 1e-12)
        assert len(faint) + len(seen) == len(weights)
        shown = axes.collections[1].get_array()
        np.testing.assert_array_equal(shown, np.sort(weights[weights >= 1e-12]))
        sizes = axes.collections[1].get_sizes()
        assert (np.diff(sizes) >= 0.0).all()

    def test_falls_add_up_to_what_the_chain_says(self, mesh, found):
        by_slope = mesh_pictures.falls_by_slope(mesh, found.distribution)
        probabilities = slope_probabilities(mesh.slopes, 0.0, SIGMA)
        np.testing.assert_allclose(by_slope.sum(axis=0), 1.0, rtol=1e-12)
        by_way = by_slope @ probabilities
        before = mesh_pictures.falls_by_slope_before(mesh, found.distribution, probabilities)
        for falls in (by_way[1:], before.sum(axis=1)):
            assert falls.sum() == pytest.approx(found.failure_probability, rel=1e-12)
            for code, share in found.failure_shares.items():
                assert falls[code - 1] / falls.sum() == pytest.approx(share, rel=1e-12)

    def test_falls_add_up_on_correlated_ground(self, mesh, drawn):
        found = metastability(mesh, 0.0, SIGMA, 0.5)
        rows = conditional_probabilities(mesh.slopes, 0.0, SIGMA, 0.5)[mesh.preceding[1:]]
        by_slope = mesh_pictures.falls_by_slope(mesh, found.distribution, rows)
        np.testing.assert_allclose(by_slope.sum(axis=0), 1.0, rtol=1e-12)
        before = mesh_pictures.falls_by_slope_before(mesh, found.distribution, rows)
        ahead = found.distribution[1:] @ rows
        for falls in ((by_slope @ ahead)[1:], before.sum(axis=1)):
            assert falls.sum() == pytest.approx(found.failure_probability, rel=1e-12)
            for code, share in found.failure_shares.items():
                assert falls[code - 1] / falls.sum() == pytest.approx(share, rel=1e-12)
        picture = mesh_pictures.where_it_falls(mesh, found, 0.0, SIGMA, NAME, 0.5)
        assert "°, correlation 0.5, when" in picture.caption
        values, _, _ = drawn[0].axes[0].patches[0].get_data()
        np.testing.assert_allclose(values, 1.0 - by_slope[0], rtol=1e-9)

    def test_falls_by_slope_before(self):
        mesh = small_mesh([[0, 2], [5, 2]], np.zeros((3, 10)))
        mesh = replace(mesh, preceding=np.array([0, 0, 1]))
        falls = mesh_pictures.falls_by_slope_before(
            mesh, np.array([0.0, 0.75, 0.25]), np.array([0.4, 0.6])
        )
        expected = np.zeros((10, 2))
        expected[Outcome.STANCE_SLIPS - 1] = [0.75 * 0.6, 0.25 * 0.6]
        expected[Outcome.IMPACT_PULLS - 1] = [0.0, 0.25 * 0.4]
        np.testing.assert_allclose(falls, expected, rtol=1e-15)

    def test_where_it_falls(self, mesh, found, drawn):
        caption = mesh_pictures.where_it_falls(mesh, found, 0.0, SIGMA, NAME).caption
        top, middle, ahead, behind = drawn[0].axes
        chance = 1.0 - mesh_pictures.falls_by_slope(mesh, found.distribution)[0]
        values, edges, _ = top.patches[0].get_data()
        np.testing.assert_allclose(values, chance, rtol=1e-9)
        np.testing.assert_allclose(edges[1:] + edges[:-1], 2.0 * np.degrees(mesh.slopes), atol=1e-9)
        for axes, total in ((ahead, 1.0), (behind, 1.0), (middle, np.count_nonzero(chance))):
            heights = sum(
                np.sum(stack.get_data().values - stack.get_data().baseline)
                for stack in axes.patches
            )
            assert heights == pytest.approx(total, rel=1e-9)
        most = max(found.failure_shares, key=found.failure_shares.get)
        assert f"{Outcome(most).label} {found.failure_shares[most]:.1%}" in caption

    @pytest.mark.parametrize(
        "outcomes", [[0, 0, 0], [2, 0, 8], [1, 2, 3]], ids=["never", "sometimes", "always"]
    )
    def test_mesh_of_two_states(self, outcomes, drawn):
        mesh = small_mesh([outcomes])
        found = metastability(mesh, 0.0, SIGMA)
        assert "All states are one." in mesh_pictures.mesh_plane(mesh, NAME).caption
        mesh_pictures.mesh_distribution(mesh, found, 0.0, SIGMA, NAME)
        caption = mesh_pictures.where_it_falls(mesh, found, 0.0, SIGMA, NAME).caption
        assert ("cannot fall" in caption) == (not any(outcomes))
        if outcomes == [2, 0, 8]:
            for figure in drawn:
                assert style.pixels(figure).std() > 0.0

    def test_files(self, mesh, found):
        first, second = (mesh_pictures.mesh_plane(mesh, NAME) for _ in range(2))
        assert first == second
        opened(first)
        opened(mesh_pictures.mesh_distribution(mesh, found, 0.0, SIGMA, NAME))
        opened(mesh_pictures.where_it_falls(mesh, found, 0.0, SIGMA, NAME))

    def test_distribution_of_another_mesh(self, mesh, found):
        other = small_mesh([[0, 2, 0]])
        for draw in (mesh_pictures.mesh_distribution, mesh_pictures.where_it_falls):
            with pytest.raises(InputError, match="distribution"):
                draw(other, found, 0.0, SIGMA, NAME)


class TestStyle:
    def test_palette_keeps_few_colours_exactly(self):
        random = np.random.default_rng(1)
        # 20 colours that differ in more than the last two bits of a channel.
        colours = random.permutation(20)[:, None] * np.array([12, 8, 4]) + [3, 0, 100]
        frames = [colours[random.integers(0, 20, (30, 40))].astype(np.uint8) for _ in range(30)]
        for frame, image in zip(frames, style.with_palette(frames, 32), strict=True):
            np.testing.assert_array_equal(np.asarray(image.convert("RGB")), frame)

    def test_palette_of_many_colours(self):
        frame = np.random.default_rng(1).integers(0, 256, (60, 60, 3)).astype(np.uint8)
        frame[:30] = (10, 200, 30)
        (image,) = style.with_palette([frame], 16)
        found = np.asarray(image.convert("RGB"))
        assert len(np.unique(found.reshape(-1, 3), axis=0)) <= 16
        np.testing.assert_array_equal(found[:30], frame[:30])

    def test_every_way_to_fall_has_a_colour_of_its_own(self):
        assert set(style.OUTCOME_COLOURS) == set(Outcome) - {Outcome.STEP}
        assert len(set(style.OUTCOME_COLOURS.values())) == len(style.OUTCOME_COLOURS)


class TestCommand:
    def test_picture(self, tmp_path, capsys):
        path = tmp_path / "gait.png"
        arguments = ["picture", "gait", "--last-steps", "2", "--output", str(path)]
        assert main([*arguments, "--quiet"]) == 0
        assert "written to" in capsys.readouterr().out
        assert Image.open(path).format == "PNG"
        assert main(arguments) == 2
        assert "does not exist yet" in capsys.readouterr().err

    def test_picture_of_a_mesh(self, tmp_path):
        path = tmp_path / "falls.png"
        arguments = ["--slope-step", "2", "--slope-limit", "6", "--threshold", "1", "--quiet"]
        assert main(["picture", "falls", *arguments, "--output", str(path)]) == 0
        assert Image.open(path).format == "PNG"

    @pytest.mark.parametrize(
        ("kind", "name"), [("gait", "x.gif"), ("animation", "x.png"), ("mesh", "none/x.png")]
    )
    def test_file_that_cannot_be_written(self, tmp_path, capsys, kind, name):
        assert main(["picture", kind, "--output", str(tmp_path / name)]) == 2
        assert "--output" in capsys.readouterr().err

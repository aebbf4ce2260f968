"""Search spaces, searchers, the store and studies; scoring is in test_scoring.py."""

import json
import math
import os
import re
import signal
import sqlite3
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from cmaes import CMA
from scipy.optimize import minimize

from biped_mfpt_ros.cli import main
from biped_mfpt_ros.cli.study import run_rows, summary_text
from biped_mfpt_ros.control import hzd
from biped_mfpt_ros.control.controller import catalogue, controller
from biped_mfpt_ros.errors import InputError
from biped_mfpt_ros.optimise import store as store_module
from biped_mfpt_ros.optimise import study as study_module
from biped_mfpt_ros.optimise.scoring import Evaluation, Stopped
from biped_mfpt_ros.optimise.searchers import SEARCHERS, CmaEs, Told, make_searcher
from biped_mfpt_ros.optimise.settings import Stage, StudySettings
from biped_mfpt_ros.optimise.space import SearchSpace
from biped_mfpt_ros.optimise.store import Store, StoreBusy
from biped_mfpt_ros.optimise.study import Study, best_trial, confirming
from biped_mfpt_ros.report.studies import front
from biped_mfpt_ros.walker.robot import WalkerModel, rabbit

# Spaces ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", catalogue())
def test_zero_is_the_start(name):
    start = controller(name)
    space = SearchSpace(start, rabbit())
    found = space.controller(np.zeros(len(space)))
    # The paper's alpha_0 and alpha_1 are rounded to four digits; here they are computed. The rest
    # is off by the rounding of a logarithm, of up to 6, and back.
    tolerance = 5.5e-3 if name.startswith("hzd") else 0.0
    np.testing.assert_allclose(found.parameters, start.parameters, rtol=3e-15, atol=tolerance)
    assert len(space) == {"hzd": 22, "smc": 18, "spline": 42}[start.scheme]
    assert (space.bounds[:, 0] <= 0.0).all()
    assert (space.bounds[:, 1] >= 0.0).all()


def test_every_hzd_candidate_is_hybrid_invariant():
    space = SearchSpace(controller("hzd/base"), rabbit())
    vector = np.random.default_rng(1).normal(size=22)
    made = space.controller(vector)
    bezier = made.parameters[2:30].reshape(4, 7)
    # The references right after the impact are where the impact leaves the joints: q and dq.
    state = made.reference_state(1.5, rabbit())
    np.testing.assert_allclose(bezier[:, 0], state[:4], atol=1e-12)
    start, end = hzd.phase_range(bezier, rabbit())
    slope = 6.0 * (bezier[:, 1] - bezier[:, 0]) / (end - start)
    np.testing.assert_allclose(slope * hzd.phase(state[5:]), state[5:9], atol=1e-11)


def test_fixed_coordinates_stay():
    start = controller("hzd/mfpt")
    space = SearchSpace(start, rabbit(), ["k?", "alpha_*^3"])
    assert len(space) == 15
    assert not {c.name for c in space.coordinates} & {"kp", "kd", "alpha_4^3"}
    made = space.controller(np.ones(15))
    names = hzd.PARAMETERS
    for name in ("kp", "kd", "alpha_2^3", "alpha_6^3"):
        i = names.index(name)
        assert made.parameters[i] == pytest.approx(start.parameters[i], rel=1e-14)
    i = names.index("alpha_4^1")
    assert made.parameters[i] == pytest.approx(start.parameters[i] + 0.02)
    with pytest.raises(InputError, match="fixed: 'omega'"):
        SearchSpace(start, rabbit(), ["omega"])
    with pytest.raises(InputError, match="leave something free"):
        SearchSpace(start, rabbit(), ["*"])


def test_what_is_no_gait_is_an_input_error():
    space = SearchSpace(controller("hzd/mfpt"), rabbit())
    with pytest.raises(InputError):
        space.controller(np.full(22, math.nan))


# Searchers ---------------------------------------------------------------------------------------

TARGET = np.array([1.3, -0.7, 0.4, 2.0])


def quadratic(x):
    return float((np.array([1.0, 3.0, 10.0, 0.3]) * (x - TARGET) ** 2).sum())


def told(x):
    if x.size == 4 and x[3] > 4.5:  # a constraint, away from the optimum
        return Told(-1e3 - x[3], (math.nan, math.nan), x[3] - 4.5)
    return Told(-quadratic(x), (quadratic(x), float(np.abs(x).sum())), 0.0)


BOUNDS = np.array([[-5.0, 5.0]] * 4)


def searched(name, most, seed=3, objectives=2):
    searcher = make_searcher(name, BOUNDS, seed=seed, objectives=objectives)
    asked = []
    while sum(map(len, asked)) < most and not searcher.done:
        vectors = searcher.ask()
        assert vectors.shape[1] == 4
        assert (np.abs(vectors) <= 5.0).all()
        np.testing.assert_array_equal(vectors, searcher.ask())
        asked.append(vectors)
        searcher.tell(vectors, [told(x) for x in vectors])
    searcher.close()
    return np.concatenate(asked), searcher.done


@pytest.mark.parametrize("name", [name for name in SEARCHERS if name != "given"])
def test_searcher_starts_at_the_start_and_is_reproducible(name):
    first, _ = searched(name, 150)
    again, _ = searched(name, 150)
    assert not first[0].any()
    assert first.tobytes() == again.tobytes()
    if name in ("cma-es", "nsga2"):
        other, _ = searched(name, 150, seed=4)
        assert first.tobytes() != other.tobytes()


@pytest.mark.parametrize(("name", "within"), [("cma-es", 1e-6), ("nelder-mead", 1e-5),
                                              ("pattern", 1e-5)])  # fmt: skip
def test_searcher_finds_the_optimum(name, within):
    found, _ = searched(name, 2000)
    assert min(map(quadratic, found)) < within


def generations(runs, number):
    """Of CMA-ES: run, candidates and best score of each."""
    searcher = make_searcher("cma-es", BOUNDS, seed=3, runs=runs, population=4)
    out = []
    for _ in range(number):
        run, vectors = searcher.run, searcher.ask()
        scores = [told(x) for x in vectors]
        searcher.tell(vectors, scores)
        out.append((run, vectors.tobytes(), max(one.score for one in scores)))
    return out[1:]  # without the start


def test_the_better_runs_of_cma_es_go_on():
    found = generations(5, 300)
    left = [1, 2, 3, 4, 5]
    for wanted in (3, 2, 1):  # the better half, and the one in the middle
        heat, found = found[: CmaEs.HEAT * len(left)], found[CmaEs.HEAT * len(left) :]
        assert [run for run, _, _ in heat] == left * CmaEs.HEAT
        so_far = {run: max(s for r, _, s in generations(5, 300)[: 300 - 1 - len(found)] if r == run)
                  for run in left}  # fmt: skip
        left = sorted(sorted(left, key=so_far.__getitem__)[-wanted:])
    assert len(found) > CmaEs.HEAT
    assert {run for run, _, _ in found} == set(left)


def test_runs_of_cma_es_differ_and_the_first_is_that_of_a_search_of_one():
    found = generations(3, 1 + 3 * CmaEs.HEAT)
    runs = [[vectors for r, vectors, _ in found if r == run] for run in (1, 2, 3)]
    assert len({*map(tuple, runs)}) == 3
    alone = [vectors for _, vectors, _ in generations(1, 1 + CmaEs.HEAT)]
    assert runs[0] == alone
    # Studies of a time when there was but one go on: its random numbers are the same.
    seed = int(np.random.SeedSequence([3, 0]).generate_state(1)[0])
    cma = CMA(np.zeros(4), 1.0, BOUNDS, seed=seed, population_size=4)
    assert alone[0] == np.array([cma.ask() for _ in range(4)]).tobytes()


def test_a_run_of_cma_es_that_has_converged_is_restarted_from_its_best_with_twice_as_many():
    searcher = make_searcher("cma-es", BOUNDS, seed=3, step=0.1, population=6)
    best, size = np.zeros(4), 6
    for _ in range(1000):
        vectors = searcher.ask()
        if len(vectors) > size:
            break
        assert len(vectors) in (1, size)
        searcher.tell(vectors, [told(x) for x in vectors])
        best = min([best, *vectors], key=quadratic)
    assert len(vectors) == 2 * size
    assert np.abs(best - TARGET).max() < 1e-3
    # Normal numbers with the first step: of 48 none is beyond six, and the start is 20 away.
    assert np.abs(vectors - best).max() < 0.6


def test_pattern_search_doubles_or_halves_its_mesh():
    searcher = make_searcher("pattern", BOUNDS[:2], step=0.25)
    searcher.tell(searcher.ask(), [Told(0.0, (), 0.0)])
    centre, size, best = np.zeros(2), 0.25, 0.0
    cross = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    for better in [*[True] * 5, False, True, *[False] * 100]:
        asked = searcher.ask()
        np.testing.assert_array_equal(asked, np.clip(centre + size * cross, -5.0, 5.0))
        scores = [best] * 4  # as good is not better
        if better:
            scores[1:3] = best + 1.0, best + 2.0
            centre, best = asked[2], best + 2.0
        size *= 2.0 if better else 0.5
        searcher.tell(asked, [Told(score, (), 0.0) for score in scores])
        if searcher.done:
            break
    assert centre[0] == -5.0  # the mesh has come to the bound
    assert size < 1e-4 * 0.25 <= 2.0 * size


def test_nsga2_spreads_over_the_front():
    found, _ = searched("nsga2", 2000)
    assert not found[1].any()  # the start takes part
    ends = min(map(quadratic, found)), min(np.abs(x).sum() for x in found)
    assert ends[0] < 0.05  # one end: the optimum of the first objective
    assert ends[1] == 0.0  # the other: the start is that of the second


def test_nsga2_keeps_to_constraints():
    # Both objectives are best at 0, where the constraint x_0 >= 1 does not hold.
    searcher = make_searcher("nsga2", BOUNDS, seed=3, objectives=2)
    found = np.zeros((0, 4))
    while len(found) < 2000:
        vectors = searcher.ask()
        searcher.tell(vectors, [
            Told(0.0, (float((x**2).sum()), float(np.abs(x).sum())), max(0.0, 1.0 - x[0]))
            for x in vectors
        ])  # fmt: skip
        found = np.concatenate([found, vectors])
    holds = found[:, 0] >= 1.0
    assert holds[-200:].mean() > 0.5
    assert 1.0 <= (found[holds] ** 2).sum(axis=1).min() < 1.05


def test_nelder_mead_is_that_of_scipy():
    asked, done = searched("nelder-mead", 10_000)
    assert done
    simplex = np.concatenate([np.zeros((1, 4)), np.eye(4)])
    result = minimize(
        quadratic, simplex[0], method="Nelder-Mead", bounds=[(-5, 5)] * 4,
        options={"initial_simplex": simplex, "xatol": 1e-4, "fatol": 1e-6},
    )  # fmt: skip
    assert len(asked) == result.nfev
    np.testing.assert_array_equal(min(asked, key=quadratic), result.x)


def test_unknown_searcher_is_an_input_error():
    with pytest.raises(InputError, match="one of cma-es"):
        make_searcher("luck", np.array([[-1.0, 1.0]]))


# Studies -----------------------------------------------------------------------------------------


class Scored:
    """Stands for `evaluate`: a quadratic of the vector, and what was scored by whom."""

    def __init__(self, seconds=0.0):
        self.seconds = seconds
        self.calls = []
        self.at_most = None
        self.together, self.met = None, set()

    def __call__(self, make, settings, best, backend, stopping):
        # The first generation is of one trial.
        if self.together is not None and self.calls and threading.get_ident() not in self.met:
            self.met.add(threading.get_ident())
            self.together.wait(300.0)
        if self.at_most is not None and len(self.calls) >= self.at_most:
            raise Stopped
        self.calls.append(threading.get_ident())
        parameters = make().parameters
        time.sleep(self.seconds)
        score = -float(np.square(parameters - 0.5 * settings.start.parameters).sum())
        # What is confirmed depends on the best before: so must be equal however it is run.
        stage = "confirmed" if score > best.score else "mesh 1"
        values = {"mfpt": score, "cot": 0.1, "speed": 1.0}
        return Evaluation(stage, score, (-score,), 0.0, values)


SETTINGS = StudySettings(controller("smc/base"), seed=5)
# Four runs take turns until trial 289, two of them until trial 433.
RACE = StudySettings(controller("smc/base"), seed=5, population=4)


@pytest.fixture
def scored(monkeypatch):
    found = Scored()
    monkeypatch.setattr(study_module, "evaluate", found)
    return found


def run(path, trials=40, workers=1, owner=None, settings=SETTINGS, **more):
    store = Store(path)
    study = Study(store, "test", settings, owner)
    try:
        return study.run(None, workers, trials, **more), outline(study)
    finally:
        study.close()
        store.close()


def outline(study):
    return [
        (t.number, t.generation, t.vector.tobytes(), t.found and (t.found.score, t.found.stage))
        for t in study.trials()
    ]


@pytest.mark.parametrize(
    ("searcher", "trials"), [("cma-es", 450), ("nelder-mead", 40), ("pattern", 40)]
)
def test_trials_do_not_depend_on_the_number_of_workers(scored, tmp_path, searcher, trials):
    settings = replace(RACE, searcher=searcher)
    reason, one = run(tmp_path / "1.sqlite", trials, settings=settings)
    scored.seconds = 1e-3
    _, four = run(tmp_path / "4.sqlite", trials, workers=4, settings=settings)
    assert reason == "trials"
    assert sum(t[3] is not None for t in one) == trials
    assert one == four
    assert len(scored.calls) == 2 * trials


def test_a_study_that_was_stopped_goes_on_as_if_it_had_not_been(scored, tmp_path):
    _, undisturbed = run(tmp_path / "whole.sqlite", 460, settings=RACE)
    scored.calls.clear()
    for most in (1, 8, 320, 440):  # at the start, and with four runs, two and one left
        scored.at_most = most
        run(tmp_path / "parts.sqlite", 460, settings=RACE)
    scored.at_most = None
    _, parts = run(tmp_path / "parts.sqlite", 460, workers=2, settings=RACE)
    assert parts == undisturbed
    assert len(scored.calls) == 460  # none was scored twice
    # More trials of the same study: those of a longer one from the start.
    parts = run(tmp_path / "parts.sqlite", 480, settings=RACE)[1]
    assert parts == run(tmp_path / "long.sqlite", 480, settings=RACE)[1]


def test_runs_are_told_from_the_store_and_the_best_is_that_of_all(scored, tmp_path):
    run(tmp_path / "s.sqlite", 450, settings=RACE)
    store = Store(tmp_path / "s.sqlite")
    study = Study(store, "test")
    trials = [t for t in study.trials() if t.found is not None]
    runs = [study.run_of(t.generation) for t in trials]
    assert runs[:17] == [1] + [1] * 4 + [2] * 4 + [3] * 4 + [4] * 4
    assert runs[1:289] == runs[1:17] * 18
    assert len({*runs[289:433]}) == 2
    assert len({*runs[433:]}) == 1
    confirmed = [t for t in trials if t.found.confirmed]
    assert best_trial(trials).found.score == max(t.found.score for t in confirmed)
    assert study.runs_left() == [runs[-1]]
    text = summary_text(study, trials)
    assert text.count(", ended\n") == 3
    assert "it takes more" not in text
    rows = run_rows(study, trials)
    assert [row["trials"] for row in rows] == [runs.count(k) for k in (1, 2, 3, 4)]
    for row in rows:
        of_run = [t.found.score for t, k in zip(trials, runs, strict=True) if k == row["run"]]
        assert row["score"] == max(of_run)
    store.close()


def test_two_owners_share_a_study_and_score_nothing_twice(scored, tmp_path):
    _, undisturbed = run(tmp_path / "whole.sqlite", 60)
    scored.calls.clear()
    scored.together = threading.Barrier(4)  # so that none has done it all before another begins
    shared = tmp_path / "shared.sqlite"
    threads = [
        threading.Thread(target=run, args=(shared, 60, 2, f"elsewhere:{i}:0")) for i in (1, 2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(scored.calls) == 60
    scored.together = None
    _, trials = run(shared, 60)
    assert trials == undisturbed
    store = Store(shared)
    owners = {t.owner for t in Study(store, "test").trials() if t.found is not None}
    assert owners == {"elsewhere:1:0", "elsewhere:2:0"}
    store.close()


def test_a_new_store_waits_for_another_that_writes_to_it(tmp_path):
    other = sqlite3.connect(tmp_path / "s.sqlite", isolation_level=None, check_same_thread=False)
    other.execute("BEGIN IMMEDIATE")  # what makes SQLite refuse a write-ahead log at once
    release = threading.Timer(0.3, other.execute, ("ROLLBACK",))
    release.start()
    Store(tmp_path / "s.sqlite").close()
    release.join()
    other.close()


@pytest.mark.parametrize("new", [True, False])
def test_a_store_that_another_never_ceases_to_write_to_says_so(tmp_path, monkeypatch, capsys, new):
    path = tmp_path / "s.sqlite"
    monkeypatch.setattr(store_module, "_WAIT_SECONDS", 0.1)
    store = None if new else Store(path)
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    said = f"store {path}: someone else has been writing to it for 0.1 s; try again when "
    with pytest.raises(StoreBusy, match=re.escape(said)):
        (store or Store(path)).create("test", SETTINGS)
    assert main(["optimise", "--controller", "hzd/mfpt", "--local", "--store", str(path)]) == 1
    assert said in capsys.readouterr().err
    other.close()
    if store is not None:
        store.close()


@pytest.mark.parametrize("owner", ["elsewhere:1:0", None])
def test_claims_of_a_dead_owner_are_taken_over(scored, tmp_path, monkeypatch, owner):
    path = tmp_path / "s.sqlite"
    store = Store(path)
    study = Study(store, "test", SETTINGS)
    store.propose(study._id, 0, 0, np.zeros((1, 18)))
    # On this host a process that is gone is known to be; of another one only silence tells.
    dead = owner or store_module.this_owner().rpartition(":")[0] + ":0"
    assert store.claim(study._id, dead, 10).number == 0
    if owner is not None:
        assert store.claim(study._id, "me:1:0", 10) is None
        monkeypatch.setattr(store_module, "STALE_SECONDS", -1.0)
    assert store.claim(study._id, "me:1:0", 10).number == 0
    found = Evaluation("falls", -1.0)
    assert not store.finish(study._id, 0, dead, found, "")  # it has lost it
    assert store.finish(study._id, 0, "me:1:0", found, "")
    assert store.trials(study._id)[0].found == found
    store.close()


def test_an_error_of_the_backend_gives_the_trial_back(tmp_path, monkeypatch):
    def fails(*args):
        raise OSError("no network")

    monkeypatch.setattr(study_module, "evaluate", fails)
    with pytest.raises(OSError, match="no network"):
        run(tmp_path / "s.sqlite", workers=2)
    store = Store(tmp_path / "s.sqlite")
    assert [t.status for t in Study(store, "test").trials()] == ["pending"]
    store.close()


def test_stop_and_deadline_end_a_study(scored, tmp_path):
    scored.seconds = 0.01
    stop = threading.Event()
    begun = time.monotonic()
    reason, _ = run(
        tmp_path / "s.sqlite", trials=None, stop=stop,
        on_trial=lambda t: t.number == 5 and stop.set(),
    )  # fmt: skip
    assert reason == "stopped"
    assert len(scored.calls) == 6
    reason, _ = run(tmp_path / "s.sqlite", trials=None, seconds=0.2)
    assert reason == "seconds"
    assert time.monotonic() - begun < 300.0


def test_a_signal_stops_a_study_whichever_thread_it_comes_to(scored, tmp_path, monkeypatch):
    """The main thread that waits is not always woken by it."""

    def interrupt(number, frame):
        raise KeyboardInterrupt

    def in_a_worker(*args):
        if not scored.calls:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})
            os.kill(os.getpid(), signal.SIGUSR1)
        return scored(*args)

    monkeypatch.setattr(study_module, "evaluate", in_a_worker)
    scored.seconds = 0.01
    scored.at_most = 1000  # it would have no end
    handler = signal.signal(signal.SIGUSR1, interrupt)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR1})
    try:
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "s.sqlite", trials=None)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR1})
        signal.signal(signal.SIGUSR1, handler)
    assert len(scored.calls) < 1000


def confirmed(cot, mfpt, stage="confirmed"):
    return Evaluation(stage, mfpt - cot, (), 0.0, {"mfpt": mfpt, "cot": cot})


# Trial 2 is beaten by 1 and 4 in both, 3 is not confirmed, 5 equals 1.
FOUND = [confirmed(0.1, 10.0), confirmed(0.2, 1e3), confirmed(0.3, 500.0),
         confirmed(0.05, 1e9, "mesh 1"), confirmed(0.15, 600.0), confirmed(0.2, 1e3)]  # fmt: skip


@pytest.fixture
def searched_study(tmp_path):
    store = Store(tmp_path / "searched.sqlite")
    study = Study(store, "searched", replace(SETTINGS, fixed=("k*",), limits={"speed_min": 0.5}))
    vectors = np.random.default_rng(1).normal(size=(len(FOUND), len(study.space)))
    vectors *= 0.1
    store.propose(study._id, 0, 0, vectors)
    for number, found in enumerate(FOUND):
        store.claim(study._id, "me:1:0", len(FOUND))
        assert store.finish(study._id, number, "me:1:0", found, "")
    yield study
    store.close()


def test_the_front_of_a_study_is_tried_again(scored, searched_study):
    before = searched_study
    settings = confirming(before, stages=(Stage(0.25, 0.03),), seed=7)
    vectors = [before.trials()[number].vector for number in (1, 4, 0)]  # most steps first
    assert settings.candidates == tuple(tuple(v) for v in vectors)
    assert settings.start is before.settings.start
    assert (settings.fixed, settings.limits) == (("k*",), {"speed_min": 0.5})
    assert (settings.stages, settings.seed) == ((Stage(0.25, 0.03),), 7)
    study = Study(before.store, "again", settings)
    scored.at_most = 1
    assert study.run(None, 1) == "stopped"
    scored.at_most = None
    # Taken up from the store alone, and there is an end to it.
    study = Study(before.store, "again")
    assert study.settings.as_json() == settings.as_json()
    assert study.run(None, 2) == "converged"
    assert [t.vector.tobytes() for t in study.trials()] == [v.tobytes() for v in vectors]
    assert len(scored.calls) == 3
    for new, number in zip(study.trials(), (1, 4, 0), strict=True):
        same = before.controller(before.trials()[number]).parameters
        assert study.controller(new).parameters.tobytes() == same.tobytes()
    assert study.run(None, 1) == "converged"
    assert len(scored.calls) == 3


def test_the_picture_of_a_front_is_of_what_is_confirmed(searched_study):
    store, study = searched_study.store, searched_study
    store.propose(study._id, 1, len(FOUND), np.ones((2, len(study.space))))
    checked = confirmed(0.3, 500.0)  # beaten
    checked.values["check_steps"] = 9.0
    # Without an end it has no place on the axis, whatever it costs.
    for number, found in enumerate((checked, confirmed(0.01, math.inf)), len(FOUND)):
        store.claim(study._id, "me:1:0", 99)
        store.finish(study._id, number, "me:1:0", found, "")
    picture = front([study], paper=False)
    assert "smc: 3 on the front of 6 confirmed, 0 of these checked by walks" in picture.caption
    assert picture.data.startswith(b"\x89PNG")


def test_every_objective_counts_for_the_front(tmp_path):
    store = Store(tmp_path / "s.sqlite")
    settings = replace(SETTINGS, searcher="nsga2", objectives={"mfpt": 1.0, "speed": 1.0})
    study = Study(store, "s", settings)
    with pytest.raises(InputError, match="study: 's' is not allowed"):
        confirming(study)
    store.propose(study._id, 0, 0, np.eye(len(study.space))[:2])
    # The second is slower to fall and cheaper, but the first is faster.
    for number, (cot, mfpt, speed) in enumerate([(0.2, 10.0, 0.9), (0.1, 20.0, 0.8)]):
        store.claim(study._id, "me:1:0", 9)
        found = confirmed(cot, mfpt)
        found.values["speed"] = speed
        store.finish(study._id, number, "me:1:0", found, "")
    assert len(confirming(study).candidates) == 2
    store.close()


def test_candidates_are_those_of_the_space(tmp_path):
    store = Store(tmp_path / "s.sqlite")
    for wrong in ((0.0,) * 17, (math.nan,) * 18):
        settings = replace(SETTINGS, searcher="given", candidates=((0.0,) * 18, wrong))
        with pytest.raises(InputError, match=r"candidates\[1\].*18 finite numbers"):
            Study(store, "s", settings)
    assert store.names() == []  # nothing was written
    store.close()


def test_a_study_without_workers_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"^workers: 0"):
        run(tmp_path / "s.sqlite", workers=0)


def test_settings_survive_json_and_other_ones_are_refused(scored, tmp_path):
    settings = StudySettings(
        controller("hzd/mfpt"), "nsga2", fixed=("k?",), objectives={"mfpt": 1.0, "cot": 20.0},
        limits={"speed_min": 0.5}, model=WalkerModel(torque_limit=math.inf),
        stages=(Stage(1.0, 1.0), Stage(0.5, 0.3, -0.1, 500)), check_sigmas=(),
    )  # fmt: skip
    again = StudySettings.from_json(settings.as_json())
    assert again.as_json() == settings.as_json()
    assert again.model == settings.model
    assert again.stages == settings.stages
    # Studies that were begun before there were these go on.
    assert not {"candidates", "correlation", "runs"} & set(again.as_json())
    rolling = replace(settings, correlation=0.5)
    assert StudySettings.from_json(rolling.as_json()).correlation == 0.5
    assert StudySettings.from_json(replace(RACE, runs=1).as_json()).run_count == 1
    assert StudySettings.from_json(RACE.as_json()).run_count == RACE.run_count == 4
    given = replace(settings, searcher="given", candidates=((0.1,) * 20, (1.0 / 3.0,) * 20))
    again = StudySettings.from_json(json.loads(json.dumps(given.as_json())))
    assert (again.candidates, again.as_json()) == (given.candidates, given.as_json())
    run(tmp_path / "s.sqlite", 1)
    with pytest.raises(InputError, match="seed \\(was 5\\)"):
        run(tmp_path / "s.sqlite", 1, settings=StudySettings(controller("smc/base"), seed=6))
    store = Store(tmp_path / "s.sqlite")
    with pytest.raises(InputError, match=r"one of those in .*: test"):
        Study(store, "other")
    store.close()


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("searcher", {"searcher": "luck"}),
        ("searcher", {"searcher": "nsga2"}),
        ("candidates", {"searcher": "given"}),
        ("candidates", {"candidates": ((0.0,) * 22,)}),
        ("objectives", {"objectives": {"beauty": 1.0}}),
        ("objectives[mfpt]", {"objectives": {"mfpt": -1.0}}),
        ("limits", {"limits": {"weight_max": 1.0}}),
        ("sigma_s", {"sigma_s": math.nan}),
        ("correlation", {"correlation": 1.0}),
        ("threshold", {"stages": (Stage(0.5, 0.0),)}),
        ("slope_step_deg", {"stages": (Stage(0.3, 0.1),)}),
        ("max_states", {"stages": (Stage(0.5, 0.1, max_states=1),)}),
        ("max_states", {"stages": (Stage(0.5, 0.1, max_states=2**32),)}),
        ("stages", {"stages": ()}),
        ("mu_s", {"mu_s": 0.35}),
        ("seed", {"seed": -1}),
        ("limits[speed_min]", {"limits": {"speed_min": -0.1}}),
        ("check_walks", {"check_walks": 0}),
        ("step", {"step": 0.0}),
        ("population", {"population": 1}),
        ("runs", {"runs": -1}),
        ("runs", {"runs": 1001}),
        ("runs", {"runs": 2, "searcher": "pattern"}),
        ("margin", {"stages": (Stage(0.5, 0.3, math.nan),)}),
        ("check_sigmas", {"check_sigmas": (1.0, math.nan)}),
        ("check_steps", {"check_steps": math.nan}),
        ("trial_seconds", {"trial_seconds": math.inf}),
    ],
)
def test_bad_settings_are_refused(field, change):
    with pytest.raises(InputError) as error:
        StudySettings(controller("hzd/mfpt"), **change)
    assert error.value.field == field


def test_a_file_that_is_no_store_is_refused(tmp_path):
    (tmp_path / "text").write_text("no database, but long enough to be read as one" * 100)
    with pytest.raises(InputError, match="store"):
        Store(tmp_path / "text")

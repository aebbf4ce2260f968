"""Answers on disk: the mesh is the same, also when the file was cut off or spoiled."""

import fcntl
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from test_mesh import SLOPES, START, Toy, same_mesh

from biped_mfpt_ros.chain.journal import Journal, JournalInUse
from biped_mfpt_ros.chain.mesh import MeshGrowth, grow_mesh


class Counting(Toy):
    """Counts the states that it simulated."""

    count = 0

    def __call__(self, states, previous_slopes):
        self.count += len(states)
        return super().__call__(states, previous_slopes)


def grow(journal, simulate, threshold=0.05, chunk=7, most=None, **options):
    """Grow in chunks, as the mesher does; stop after `most` of them."""
    growth = MeshGrowth(START, SLOPES, threshold, answers=journal, **options)
    handed_out, done = 1, 0
    while not growth.complete and done != most:
        start, handed_out = growth.unanswered(handed_out, chunk)
        assert handed_out > start
        done += 1
        growth.take(start, simulate(*growth.states(start, handed_out)), handed_out - start)
    return growth


@pytest.fixture(scope="module")
def whole():
    return grow_mesh(Toy(), START, SLOPES, 0.05)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A journal of the whole mesh, as bytes."""
    path = tmp_path_factory.mktemp("written") / "journal"
    journal = Journal(len(SLOPES), b"this", path)
    grow(journal, Toy())
    journal.close()
    return path.read_bytes()


def resume(path, content, whole):
    """Grow on from a file; the mesh must be the same. Returns how many states were simulated."""
    path.write_bytes(content)
    journal, simulate = Journal(len(SLOPES), b"this", path), Counting()
    growth = grow(journal, simulate)
    assert same_mesh(growth.mesh(), whole)
    assert simulate.count + growth.resumed == growth.known - 1
    journal.close(remove=True)
    assert not path.exists()
    return simulate.count


# In a file, with a name and without one, in memory, and some here and some there.
@pytest.mark.parametrize(("named", "kept"), [(True, 1e9), (False, 0), (False, 1e9), (False, 1e4)])
@pytest.mark.parametrize("options", [{}, {"clustered": False}, {"scale_refresh": "addition"}])
def test_mesh_with_a_journal_is_the_one_without(tmp_path, monkeypatch, named, kept, options):
    monkeypatch.setattr("biped_mfpt_ros.chain.journal._KEPT_BYTES", kept)
    journal = Journal(len(SLOPES), b"this", tmp_path / "journal" if named else None)
    growth = grow(journal, Toy(), **options)
    assert same_mesh(growth.mesh(), grow_mesh(Toy(), START, SLOPES, 0.05, **options))
    assert [path.name for path in tmp_path.iterdir()] == ["journal"] * named
    in_memory = sum(start in journal._kept for start in journal)
    assert (in_memory > 0) == (not named and kept > 0)
    assert (in_memory < len([*journal])) == (named or kept < 1e9)


def test_whatever_is_cut_off_is_simulated_again_and_nothing_else(tmp_path, written, whole):
    n = len(whole.states) - 1
    assert resume(tmp_path / "j", written, whole) == 0
    assert resume(tmp_path / "j", b"", whole) == n
    assert resume(tmp_path / "j", written[:-1], whole) in range(1, 8)
    rng = np.random.default_rng(5)
    counts = [
        resume(tmp_path / "j", written[:length], whole)
        for length in sorted(rng.integers(0, len(written), 25))
    ]
    assert counts == sorted(counts, reverse=True)
    assert len(set(counts)) > 10


def test_a_spoiled_record_and_all_after_it_are_dropped(tmp_path, written, whole):
    rng = np.random.default_rng(6)
    for place in rng.integers(0, len(written), 25):
        spoiled = bytearray(written)
        spoiled[place] ^= 1 << rng.integers(8)
        assert resume(tmp_path / "j", bytes(spoiled), whole) > 0
    assert resume(tmp_path / "j", written + b"\x00" * 40, whole) == 0
    assert resume(tmp_path / "j", written + written[-500:], whole) == 0


def test_answers_may_have_come_in_any_order(tmp_path, whole):
    """The last chunks in flight are lost, and others that were asked for later are there."""
    rng = np.random.default_rng(7)
    for _ in range(10):
        journal = Journal(len(SLOPES), b"this", tmp_path / "j")
        growth = MeshGrowth(START, SLOPES, 0.05, answers=journal)
        handed_out, asked, toy = 1, [], Toy()
        for _ in range(int(rng.integers(1, 40))):
            while handed_out < growth.known and len(asked) < 5:
                stop = min(growth.known, handed_out + int(rng.integers(1, 12)))
                asked.append((handed_out, stop))
                handed_out = stop
            if asked:
                start, stop = asked.pop(int(rng.integers(len(asked))))
                growth.take(start, toy(*growth.states(start, stop)), stop - start)
        answered = handed_out - 1 - sum(stop - start for start, stop in asked)
        journal.close()
        simulated = resume(tmp_path / "j", (tmp_path / "j").read_bytes(), whole)
        assert simulated == len(whole.states) - 1 - answered


def test_journal_of_another_mesh_is_begun_anew(tmp_path, written):
    path = tmp_path / "j"
    for slopes, identity in ((len(SLOPES), b"other"), (len(SLOPES) - 1, b"this")):
        path.write_bytes(written)
        journal = Journal(slopes, identity, path)
        assert list(journal) == []
        journal.close()
        assert path.stat().st_size < 100


def test_a_journal_has_one_owner(tmp_path):
    first = Journal(3, b"this", tmp_path / "j")
    with pytest.raises(JournalInUse):
        Journal(3, b"this", tmp_path / "j")
    first.close()
    Journal(3, b"this", tmp_path / "j").close()


def test_a_journal_that_its_owner_removes_meanwhile_is_made_anew(tmp_path, monkeypatch):
    path, flock, removed = tmp_path / "j", fcntl.flock, []

    def late(file, how):
        flock(file, how)
        if not removed:
            path.unlink()
            removed.append(path)

    monkeypatch.setattr(fcntl, "flock", late)
    journal = Journal(3, b"this", path)
    with pytest.raises(JournalInUse):
        Journal(3, b"this", path)
    journal.close()
    assert removed
    assert path.stat().st_size > 0


KILLED = """
import sys
import numpy as np
sys.path.insert(0, sys.argv[2])
from test_journal import SLOPES, Journal, Toy, grow
journal = Journal(len(SLOPES), b"this", sys.argv[1])
toy = Toy()
def simulate(states, previous):
    print(len(states), flush=True)
    return toy(states, previous)
grow(journal, simulate)
"""


def test_killed_process_leaves_all_answers_but_the_last(tmp_path, whole):
    path, simulated = tmp_path / "j", 0
    for chunks in (5, 30, 60):
        process = subprocess.Popen(
            [sys.executable, "-c", KILLED, str(path), str(Path(__file__).parent)],
            stdout=subprocess.PIPE,
            text=True,
        )
        asked = [int(process.stdout.readline()) for _ in range(chunks)]
        process.send_signal(signal.SIGKILL)
        asked += [int(line) for line in process.stdout.read().splitlines()]
        process.wait()
        simulated += sum(asked)
        assert process.returncode == -signal.SIGKILL
    simulated += resume(path, path.read_bytes(), whole)
    # Once a kill, a chunk of 7 or less.
    assert len(whole.states) - 1 <= simulated <= len(whole.states) - 1 + 3 * 7


def test_memory_is_400_bytes_a_state_and_the_transition_row(monkeypatch):
    kept = 1_000_000
    monkeypatch.setattr("biped_mfpt_ros.chain.journal._KEPT_BYTES", kept)
    toy = Toy(np.radians(np.arange(-20, 21) * 1.0), limit=10.0)
    m = len(toy.slopes)

    def grown(threshold):
        journal = Journal(m)
        growth = MeshGrowth(START, toy.slopes, threshold, answers=journal)
        while not growth.complete:
            start, stop = growth.unanswered(growth.tested, 200)
            growth.take(start, toy(*growth.states(start, stop)), stop - start)
        return growth.mesh()

    grown(0.3)  # what numba keeps is not the mesh's
    tracemalloc.start()
    mesh = grown(1e-2)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    n = len(mesh.states)
    assert n > 20_000
    row = (mesh.targets.itemsize + mesh.outcomes.itemsize) * m
    assert (peak - kept) / n <= 400 + row

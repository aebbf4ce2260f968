"""Chunks over simulators that fail in every way: the result is always the same, bit for bit."""

import threading
import time
from contextlib import suppress
from dataclasses import replace
from functools import partial
from queue import Empty, SimpleQueue

import numpy as np
import pytest
from biped_mfpt_msgs.srv import SimulateSteps

from biped_mfpt_ros.chain.mesh import MeshLimitError
from biped_mfpt_ros.gait.step import Steps
from biped_mfpt_ros.nodes.fan_out import FanOut, FanOutSettings, Job, NoSimulatorError
from biped_mfpt_ros.nodes.messages import fill_response, packed, unpacked

SLOPES = np.linspace(-0.2, 0.2, 7)
# Nobody is late, however busy the machine is.
PATIENT = FanOutSettings(timeout=60.0, wait_seconds=300.0, chunk_seconds=1e-3)
# Who does not answer is soon late.
QUICK = FanOutSettings(timeout=0.1, wait_seconds=300.0, chunk_seconds=1e-3)
# Nor is anyone waited for.
HASTY = FanOutSettings(timeout=0.1, wait_seconds=0.5, chunk_seconds=1e-3)


def step_map(states, previous):
    """A stand-in for the step map: any pure function of each state will do."""
    mixed = states.sum(axis=1, keepdims=True) * 1e3 + previous[:, None] + SLOPES
    outcomes = (np.abs(mixed).astype(np.uint64) % 3).astype(np.uint8)
    following = np.repeat(np.sin(states[:, None, :] + SLOPES[:, None]), 1, axis=0)
    return outcomes, following[outcomes == 0]


def right_answer(request):
    states = unpacked(request.states, "d").reshape(-1, 10)
    outcomes, following = step_map(states, unpacked(request.previous_slopes, "d"))
    response = SimulateSteps.Response(step_map=request.step_map)
    none = np.zeros((0, len(SLOPES)))
    fill_response(response, Steps(outcomes, following, none, none, none, 1e-4 * len(states), 1, 7))
    return response


class Fake:
    """Simulators that answer from threads of their own, each in its own way."""

    def __init__(self, **ways):
        self.ways = ways
        self.asked = dict.fromkeys(ways, 0)
        self.dropped = {}
        self.come = SimpleQueue()

    def found(self):
        return [name for name in self.ways if name not in self.dropped]

    def drop(self, name, reason):
        self.dropped[name] = reason

    def ask(self, name, request):
        self.asked[name] += 1
        ticket = self.asked[name]
        self.ways[name](self, request, lambda response: self.come.put((name, ticket, response)))
        return ticket

    def answers(self, timeout):
        with suppress(Empty):
            if (answer := self.come.get(timeout=timeout)) is not None:
                yield answer

    def wake(self):
        self.come.put(None)


def later(seconds, do):
    timer = threading.Timer(seconds, do)
    timer.daemon = True
    timer.start()


def good(fake, request, answer, delay=0.001):
    later(delay, lambda: answer(right_answer(request)))


def at_once(fake, request, answer):
    """In the order of the requests, however late threads are."""
    answer(right_answer(request))


def silent(fake, request, answer):
    pass


def twice(fake, request, answer):
    good(fake, request, answer)
    good(fake, request, answer, delay=0.004)


def unreachable(fake, request, answer):
    raise RuntimeError("no route")


def spoiled(spoil, fake, request, answer):
    response = right_answer(request)
    spoil(response)
    answer(response)


def short(response):
    response.outcomes = response.outcomes[:-1]


def not_finite(response):
    response.next_states = packed(np.full(len(response.next_states), np.nan), "d")


def other_version(response):
    response.step_map = "another"


def refusing(response):
    response.success = False
    response.message = "no"


@pytest.fixture
def swings():
    rng = np.random.default_rng(3)
    return rng.normal(size=(300, 10)), rng.choice(SLOPES, 300)


class Swings:
    """Swings that are all there from the beginning, with what `FanOut` needs of a growth."""

    def __init__(self, states, previous):
        self.given = states, previous
        self.known = len(states) + 1
        self.resumed = 0
        self.answers = {}

    def unanswered(self, start, most):
        return start, min(start + most, self.known)

    def states(self, start, stop):
        return tuple(array[start - 1 : stop - 1] for array in self.given)

    def take(self, start, steps, n):
        assert start not in self.answers
        assert len(steps.outcomes) == n
        self.answers[start] = steps

    def check(self):
        """All answers are there, and right to the last bit."""
        outcomes, following = step_map(*self.given)
        in_order = [self.answers[start] for start in sorted(self.answers)]
        assert b"".join(steps.outcomes.tobytes() for steps in in_order) == outcomes.tobytes()
        assert b"".join(steps.next_states.tobytes() for steps in in_order) == following.tobytes()


def fan_out(fake, settings=PATIENT, log=None):
    return FanOut(fake, settings, [].append if log is None else log.append)


def job_of(swings):
    return Job(Swings(*swings), SimulateSteps.Request(step_map="this", slopes=packed(SLOPES, "d")))


def run(fan_out, *jobs):
    """Run jobs to their ends, and check what comes out."""
    for job in jobs:
        fan_out.add(job)
    deadline = time.monotonic() + 300.0
    while any(job.frontier for job in jobs):
        fan_out.step(0.05)
        assert time.monotonic() < deadline
        for job in jobs:
            if job.error is not None:
                raise job.error
    for job in jobs:
        fan_out.remove(job)
        job.growth.check()
    return jobs[0].tally


@pytest.mark.parametrize("simulators", [1, 2, 5])
def test_all_simulators_are_used_and_answers_are_in_order(swings, simulators):
    rng = np.random.default_rng(simulators)
    fake = Fake(
        **{f"s{i}": lambda *a: good(*a, delay=rng.uniform(0, 0.01)) for i in range(simulators)}
    )
    simulate = fan_out(fake)
    tally = run(simulate, job_of(swings))
    assert all(fake.asked.values())
    assert tally.swings == 300
    assert tally.chunks_repeated == 0
    assert tally.chunks == sum(fake.asked.values())
    assert tally.step_map_seconds == pytest.approx(300e-4)
    assert simulate.in_flight() == 0


def test_jobs_share_the_simulators_and_end_side_by_side(swings):
    """A short one that comes while long ones run does not wait for them to end."""
    fake = Fake(a=at_once, b=at_once)
    simulate = fan_out(fake)
    long = [job_of(swings), job_of(swings)]
    short = job_of((swings[0][:20], swings[1][:20]))
    for job in long:
        simulate.add(job)
    simulate.step(0.05)
    simulate.add(short)
    while short.frontier:
        simulate.step(0.05)
    assert [job.tally.swings < 100 for job in long] == [True, True]
    assert abs(long[0].tally.swings - long[1].tally.swings) < 60
    for job in (short, *long):
        simulate.remove(job)
    assert simulate.in_flight() == 0


def test_a_job_that_fails_leaves_the_others_alone(swings):
    bad, good_one = job_of(swings), job_of(swings)

    def fail(start, steps, n):
        raise MeshLimitError(2, 1, 1, 0.1)

    bad.growth.take = fail
    simulate = fan_out(Fake(a=good))
    simulate.add(bad)
    run(simulate, good_one)
    assert isinstance(bad.error, MeshLimitError)
    assert bad.tally.chunks < 6


def first_three(fake, request, answer):
    """As a simulator does when swings crawl: it answers for the first states only."""
    request.states = request.states[:30]
    request.previous_slopes = request.previous_slopes[:3]
    good(fake, request, answer)


@pytest.mark.parametrize("other", [good, silent, first_three])
def test_answers_for_a_part_are_taken_and_the_rest_is_asked_again(swings, other):
    # Requests of 10 states, and an answer for 3 of them each.
    settings = QUICK if other is silent else PATIENT
    tally = run(fan_out(Fake(part=first_three, other=other), settings), job_of(swings))
    assert tally.swings == 300
    assert tally.chunks > 300 / 10
    assert (tally.chunks_repeated > 0) == (other is silent)


def busy_but_for(most, fake, request, answer):
    """Has room for some requests, and refuses what comes beyond them at once."""
    if fake.waiting >= most:
        answer(SimulateSteps.Response(busy=True, message="busy"))
        return
    fake.waiting += 1

    def done(response):
        fake.waiting -= 1
        answer(response)

    good(fake, request, done, delay=0.02)


@pytest.mark.parametrize(("room", "others"), [(1, 0), (3, 0), (0, 1), (1, 1), (3, 1)])
def test_what_a_busy_simulator_refuses_is_asked_again(swings, room, others):
    log = []
    fake = Fake(busy=partial(busy_but_for, room), **{f"s{i}": good for i in range(others)})
    fake.waiting = 0
    settings = replace(PATIENT, in_flight=6)
    tally = run(fan_out(fake, settings, log), job_of(swings))
    assert tally.swings == 300  # `Swings.take` sees to it that none comes twice
    assert tally.chunks_repeated > 0
    assert not fake.dropped
    assert any("busy refuses: busy" in line for line in log)
    # A simulator that has no room is not asked over and over.
    assert fake.asked["busy"] < 2 * 300


def test_simulators_that_stay_busy_end_the_wait(swings):
    fake = Fake(busy=partial(busy_but_for, 0))
    fake.waiting = 0
    with pytest.raises(NoSimulatorError, match="busy is late"):
        run(fan_out(fake, HASTY), job_of(swings))


@pytest.mark.parametrize(
    ("way", "dropped", "said"),
    [
        (silent, False, "has not answered"),
        (twice, False, ""),
        (unreachable, True, "could not be asked"),
        (partial(spoiled, short), True, "outcomes: 'length"),
        (partial(spoiled, not_finite), True, "next_states: 'not finite'"),
        (partial(spoiled, other_version), True, "runs step map another, not this"),
        (partial(spoiled, refusing), True, "refuses: no (3 times in a row)"),
    ],
)
def test_one_bad_simulator_beside_a_good_one(swings, way, dropped, said):
    log = []
    fake = Fake(bad=way, good=good)
    simulate = fan_out(fake, QUICK if way is silent else PATIENT, log)
    tally = run(simulate, job_of(swings))
    assert fake.asked["bad"]
    assert (fake.dropped.keys() == {"bad"}) == dropped
    assert said in "".join(log)
    if dropped:
        asked = fake.asked["bad"]
        run(simulate, job_of(swings))
        assert fake.asked["bad"] == asked
    assert tally.swings == 300
    assert (tally.chunks_repeated > 0) == (way is not twice)


def test_a_simulator_that_goes_is_replaced_by_one_that_comes(swings):
    def exchange():
        if fake.ways.pop("first", None):
            fake.asked["second"] = 0
            fake.ways["second"] = good

    def goes(fake, request, answer):
        later(0.05, exchange)

    fake = Fake(first=goes)
    log = []
    simulate = fan_out(fake, log=log)
    assert run(simulate, job_of(swings)).chunks_repeated > 0
    assert "first has gone with" in log[0]


def test_a_late_simulator_is_used_again_once_it_answers(swings):
    """Stopped for a while, as by SIGSTOP: all its answers come late, at once."""
    held = []
    goes_on = threading.Event()

    def stopped(fake, request, answer):
        if goes_on.is_set():
            good(fake, request, answer)
        else:
            held.append((fake, request, answer))

    def slow(fake, request, answer):
        good(fake, request, answer, delay=0.05)

    log = []
    fake = Fake(stopped=stopped, slow=slow)
    simulate = fan_out(fake, QUICK, log)
    run(simulate, job_of(swings))
    goes_on.set()
    for call in held:
        good(*call)
    while "stopped answers again" not in log:
        assert run(simulate, job_of(swings)).swings == 300
    simulate.settings = PATIENT  # nobody is late any more
    asked = fake.asked["stopped"]
    assert run(simulate, job_of(swings)).swings == 300
    # Many more than it would be tried with if it were late: one.
    assert fake.asked["stopped"] > asked + 5


def test_a_lost_request_is_sent_again_even_to_the_only_simulator(swings):
    lost = []

    def loses_first(fake, request, answer):
        if len(lost) < 3:
            lost.append(request)
        else:
            good(fake, request, answer)

    simulate = fan_out(Fake(only=loses_first), QUICK)
    run(simulate, job_of(swings))


def test_no_simulator_is_an_error_that_says_so(swings):
    with pytest.raises(NoSimulatorError, match="none on the graph; start one with"):
        run(fan_out(Fake(), HASTY), job_of(swings))


def test_no_good_simulator_is_an_error_that_says_why(swings):
    fake = Fake(bad=partial(spoiled, other_version), mute=silent)
    with pytest.raises(NoSimulatorError, match="mute is late; bad, dropped, runs step map another"):
        run(fan_out(fake, HASTY), job_of(swings))


def test_a_simulator_may_come_within_the_wait(swings):
    fake = Fake()
    fake.asked["late"] = 0
    later(0.3, lambda: fake.ways.update(late=good))
    run(fan_out(fake), job_of(swings))


def test_waiting_for_a_simulator_is_said_and_goes_on_when_one_comes_back(swings, monkeypatch):
    monkeypatch.setattr("biped_mfpt_ros.nodes.fan_out._QUIET", 0.1)
    fake = Fake()

    class Log(list):
        def append(self, line):
            super().append(line)
            fake.asked.setdefault("back", 0)
            fake.ways["back"] = good

    log = Log()
    run(fan_out(fake, log=log), job_of(swings))
    assert "no simulator answers: waiting for one, for 300 s" in log[0]
    assert log[1] == "there is a simulator again: going on"


def test_a_job_is_removed_promptly_and_wake_ends_the_wait(swings):
    fake = Fake(mute=silent)
    simulate = fan_out(fake, settings=FanOutSettings())
    job = job_of(swings)
    simulate.add(job)
    later(0.05, fake.wake)
    start = time.monotonic()
    simulate.step(100.0)
    assert time.monotonic() - start < 50.0
    assert simulate.in_flight() == simulate.in_flight(job) == FanOutSettings().in_flight
    simulate.remove(job)
    assert simulate.in_flight() == 0

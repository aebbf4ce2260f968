"""Goals and questions to other nodes that are asked again where their answers get lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import rclpy.action
from rclpy.task import Future

AGAIN = 5.0
"""s without an answer, after which a question is asked again; each time after twice that."""


class ActionClient(rclpy.action.ActionClient):
    """Action client whose goals may be sent by any thread.

    rclpy 9.1 makes the future of an answer twice, the second time after it has let go of its lock.
    An answer that the executor's thread takes in between goes to the first, and the caller, who has
    the second, waits for ever.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._lock = threading.RLock()

    def send_goal_async(self, *args: Any, **options: Any) -> Future[Any]:
        """Send a goal; see rclpy."""
        with self._lock:
            return super().send_goal_async(*args, **options)


class Answer:
    """The answer to what is asked again as long as there is none.

    Of two nodes each finds the other by itself. One that is asked before it has found who asks
    drops its answer 0.1 s later (rmw_fastrtps), and rclpy does not execute a goal of which it could
    not say that it is accepted. A node that was killed stays on the graph for a while, and never
    answers.

    Parameters
    ----------
    ask : callable
        Asks, and returns the future of the answer.
    leave : callable, optional
        Told an answer that comes beside the one that is taken: who was asked was only slow.
    again : float, optional
        s, until it is asked for the second time; `AGAIN` by default.
    """

    def __init__(
        self,
        ask: Callable[[], Future[Any]],
        leave: Callable[[Any], object] = lambda late: None,
        again: float | None = None,
    ) -> None:
        self._ask = ask
        self._leave = leave
        self._pause = AGAIN if again is None else again
        self.come = threading.Event()
        """Set when it has come."""
        self._futures: list[Future[Any]] = []
        self._put()

    def _put(self) -> None:
        self._due = time.monotonic() + self._pause
        self._pause *= 2.0
        future = self._ask()
        self._futures.append(future)
        future.add_done_callback(lambda _: self.come.set())

    def done(self) -> bool:
        """Whether it has come; asks again if it is time to."""
        if not self.come.is_set() and time.monotonic() >= self._due:
            self._put()
        return self.come.is_set()

    def result(self) -> Any:
        """What has come first."""
        first = next(future for future in self._futures if future.done())
        for other in self._futures:
            if other is not first:
                other.add_done_callback(lambda late: self._leave(late.result()))
        return first.result()


def accepted(send: Callable[[], Future[Any]]) -> Answer:
    """Answer to a goal: its handle. If more than one is accepted, the others are cancelled.

    Parameters
    ----------
    send : callable
        Sends the goal, and returns the future of its handle.
    """

    def cancel(handle: Any) -> None:
        if handle.accepted:
            handle.cancel_goal_async()

    return Answer(send, cancel)

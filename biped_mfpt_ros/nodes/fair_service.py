"""A service that computes in a thread, its clients in turn, with a bound on what waits."""

from __future__ import annotations

import threading
import time
import traceback
import uuid
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rclpy.node import Node

from biped_mfpt_ros.nodes.qos import REQUESTS

_MOST_OF_NAME = 256  # characters of a client's name that count
_TURN = 0.05  # s, that a turn is worth: half of what a mesher asks for at once
_MOST_DEBT = 10.0  # s

T = TypeVar("T")


def client_name(node: Node) -> str:
    """What a node calls itself in its requests; no other node does, of the same name or not."""
    return f"{node.get_fully_qualified_name()} {uuid.uuid4().hex}"


class Waiting(Generic[T]):
    """What waits for its turn: first come, first served by client, the clients in turn.

    Who took long when it was its turn is passed over for as many turns as that was worth (deficit
    round robin): clients that always ask get the same time each, whatever a request costs. One that
    invents names gets more turns, but the others still get theirs, once among all that wait.

    Parameters
    ----------
    most : int
        How many may wait. One more, and the client with the most loses its newest.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._count = 0
        # Whose turn it is comes first. Nobody is in here with nothing.
        self._queues: OrderedDict[str, deque[T]] = OrderedDict()
        # s, that clients had beyond their turns, also of such as have nothing here now.
        self._debts: dict[str, float] = {}

    def __len__(self) -> int:
        """How many wait."""
        return self._count

    def put(self, client: str, item: T) -> T | None:
        """Let one wait. Returns the one that there is no room for then, if any."""
        self._queues.setdefault(client, deque()).append(item)
        self._count += 1
        if self._count <= self._most:
            return None
        # Of those with as many as another, who came last: else a newcomer could push others out.
        longest = max(reversed(self._queues), key=lambda name: len(self._queues[name]))
        return self._take(longest, deque.pop)[1]

    def get(self) -> tuple[str, T]:
        """Client and item of who is next, of one at least."""
        while (client := next(iter(self._queues))) in self._debts:
            self._pay(client, _TURN)
            self._queues.move_to_end(client)
        self._queues.move_to_end(client)
        return self._take(client, deque.popleft)

    def charge(self, client: str, seconds: float) -> None:
        """Tell how long it took (s) what `get` gave."""
        for other in [name for name in self._debts if name not in self._queues]:
            self._pay(other, seconds)
        debt = self._debts.pop(client, 0.0) + seconds - _TURN
        if debt > 0.0:
            self._debts[client] = min(debt, _MOST_DEBT)

    def _pay(self, client: str, seconds: float) -> None:
        self._debts[client] -= seconds
        if self._debts[client] < 1e-6:  # s: rounding is no debt
            del self._debts[client]

    def _take(self, client: str, take: Callable[[deque[T]], T]) -> tuple[str, T]:
        queue = self._queues[client]
        item = take(queue)
        self._count -= 1
        if not queue:
            del self._queues[client]
        return client, item


@dataclass(eq=False)
class _Request:
    asked: Any
    header: Any


class FairService:
    """A service of a node, computed in a thread while the node's executor takes further requests.

    A ROS 2 service has one queue for all clients, which loses the oldest request when it is full,
    and rclpy does not tell whose request is whose. So this empties that queue at once, and goes by
    the ``client`` that requests name. No request that is taken is left without an answer.

    Answers are sent by the thread that computes them. Sent by the executor they would cost it two
    more turns, in each of which it looks at all that the node has.

    Parameters
    ----------
    node : rclpy.node.Node
        On which the service is.
    kind : type
        Of the service. Its requests have ``client``; its responses ``success``, ``busy``,
        ``message``.
    name : str
        Of the service.
    most : int
        Requests that may wait. Beyond that they are refused as ``busy``; see `Waiting`.
    thread : concurrent.futures.Executor
        Of one thread. Between any two requests it gets to what else it was given.
    compute : callable
        Told a request, in the thread, and the response to fill. Returns the response, and never
        raises.
    """

    def __init__(
        self,
        node: Node,
        kind: Any,
        name: str,
        most: int,
        thread: Executor,
        compute: Callable[[Any, Any], Any],
    ) -> None:
        self._node = node
        self._kind = kind
        self._most = most
        self._thread = thread
        self._compute = compute
        self._lock = threading.Lock()
        self._waiting: Waiting[_Request] = Waiting(most)
        self._working = False
        service = node.create_service(kind, name, lambda asked, _: asked, qos_profile=REQUESTS)
        self._send = service.send_response
        # The executor calls it with what the callback returns, and the header, which answers need
        # and no callback is told.
        service.send_response = self._serve

    def _serve(self, asked: Any, header: Any) -> None:
        with self._lock:
            refused = self._waiting.put(asked.client[:_MOST_OF_NAME], _Request(asked, header))
            if not self._working:
                self._working = True
                self._thread.submit(self._work)
        if refused is not None:
            message = (
                f"busy: at most {self._most} requests wait, and no client has more than this one; "
                "ask again later"
            )
            self._answer(refused, self._kind.Response(busy=True, message=message))

    def _work(self) -> None:
        """Answer the next request, and have what else the thread has to do done before another."""
        with self._lock:
            client, request = self._waiting.get()
        start = time.perf_counter()
        self._answer(request, self._compute(request.asked, self._kind.Response()))
        with self._lock:
            self._waiting.charge(client, time.perf_counter() - start)
            self._working = len(self._waiting) > 0
            if self._working:
                self._thread.submit(self._work)

    def _answer(self, request: _Request, response: Any) -> None:
        try:
            self._send(response, request.header)
        except Exception:
            # The client has gone, or the node ends.
            if self._node.context.ok():
                self._node.get_logger().error(
                    f"a request could not be answered; going on\n{traceback.format_exc()}"
                )

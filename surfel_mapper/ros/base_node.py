# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The rclpy features that the node builds on: a guarded Node, timers, and waiting in a callback.

rclpy raises if a time on /clock is negative, or if a parameter is set to a value of an unknown
type. Either error ends the executor and with it the node, so any process in the ROS domain could
end it. ``BaseNode`` ignores or refuses such messages. Any error of a callback would do the same,
so each callback runs in ``surviving``: the error is counted and logged, a request is refused, and
the node goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from functools import wraps
import inspect
import threading
import types
from typing import Any, TypeVar

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from surfel_mapper.errors import ConfigError
from surfel_mapper.pipeline.drops import described
from surfel_mapper.ros.line_logger import LineLogger
from surfel_mapper.threads import end_real_time

PARAMETER_TYPES = {kind.value for kind in Parameter.Type}

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""The last message is kept for subscribers that come later."""

MAX_PARAMETERS = 500
"""Limit of the parameters, or prefixes of names, in a request: the node has 180, and to refuse
20,000 unknown ones took 14 s, in which no other request was answered."""

LONGEST_PERIOD_S = 3e8
"""
Longest period of a timer, ten years. rclpy counts nanoseconds in 64 bits, which end at 292 years,
but a rate in Hz may be as low as 1e-300.
"""

Result = TypeVar('Result')


class CountedPublisher(Publisher):
    """A publisher that counts its messages, for the diagnostics."""

    num_published = 0

    def publish(self, msg: Any) -> None:
        """Publish a message, or its serialized bytes."""
        super().publish(msg)
        self.num_published += 1


class BaseNode(Node):
    """A node that survives errors of its callbacks, and counts its publications."""

    def get_logger(self) -> RcutilsLogger:
        """Return the logger of the node; its messages are one line each."""
        logger: RcutilsLogger = super().get_logger()
        if not isinstance(logger, LineLogger):
            self._logger = logger = LineLogger(logger.name)
        return logger

    def report_failure(self, task: str, error: Exception) -> None:
        """Report an error of a callback that nothing expects; overridden to count it too."""
        self.get_logger().error(f'{task} failed: {described(error)}', throttle_duration_sec=1.0)

    @contextmanager
    def surviving(self, task: str) -> Iterator[None]:
        """Report an unexpected error of a with-block, and go on."""
        try:
            yield
        except Exception as error:  # MemoryError too
            self.report_failure(task, error)

    def create_publisher(self, *args: Any, **kwargs: Any) -> Publisher:
        """Create a publisher that counts its messages."""
        return super().create_publisher(*args, publisher_class=CountedPublisher, **kwargs)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[[Any], None], *args: Any, **kwargs: Any
    ) -> Subscription:
        """Create a subscription."""
        survived = self._survived(f'a message on {topic}', callback)
        return super().create_subscription(msg_type, topic, survived, *args, **kwargs)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[..., None], *args: Any, **kwargs: Any
    ) -> Timer:
        """Create a timer."""
        survived = self._survived('a timer', callback)
        return super().create_timer(timer_period_sec, survived, *args, **kwargs)

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], **kwargs: Any
    ) -> Service:
        """Create a service."""
        if srv_type is SetParameters:
            callback = self._on_set_parameters
        if srv_type is not ChangeState:  # its errors end the node, see MapperNode
            callback = self._answered(srv_name, callback)
        return super().create_service(srv_type, srv_name, callback, **kwargs)

    def set_each(self, parameters: Sequence[Parameter]) -> Sequence[SetParametersResult]:
        """Set each parameter of a service request, and return the results."""
        return self.set_parameters([*parameters])  # type: ignore[no-any-return]

    def _on_set_parameters(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        response.results = self.set_each([*map(Parameter.from_parameter_msg, request.parameters)])
        return response

    def _survived(self, task: str, callback: Callable[..., None]) -> Callable[..., None]:
        """Return a callback whose errors are reported."""

        @wraps(callback)
        def survived(*args: Any) -> None:
            with self.surviving(task):
                callback(*args)

        return survived

    def _answered(self, name: str, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return the callback of a service that refuses requests whose errors nothing expects."""

        @wraps(callback)
        async def answered(request: Any, response: Any) -> Any:
            try:
                check_request(request)
                answer = callback(request, response)
                return await answer if inspect.isawaitable(answer) else answer
            except ConfigError as error:
                return _refused(request, response, str(error))
            except Exception as error:  # MemoryError too
                self.report_failure(f'a request to {name}', error)
                return _refused(request, response, described(error))

        return answered


def check_request(request: Any) -> None:
    """Raise ConfigError for too many parameters or prefixes, and for values of unknown types."""
    for items in ('parameters', 'prefixes'):
        number = len(getattr(request, items, ()))
        if number > MAX_PARAMETERS:
            raise ConfigError(f'{number} {items}, expected at most {MAX_PARAMETERS}')
    for parameter in getattr(request, 'parameters', ()):
        kind = parameter.value.type
        if kind not in PARAMETER_TYPES:
            expected = f'expected 1 to {max(PARAMETER_TYPES)}'
            raise ConfigError(f'{parameter.name}: a value of type {kind}, {expected}')


def _refused(request: Any, response: Any, reason: str) -> Any:
    """Return the response that a request failed, in the terms of its service."""
    result = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results = [result] * len(request.parameters)
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = result
    elif hasattr(response, 'success'):
        response.success = False
        response.message = reason
    return response


class Ticker:
    """
    Calls a function at a rate in a thread of its own, whatever the executor does.

    Parameters
    ----------
    node : BaseNode
        Reports the errors of the function.
    name : str
        Name of the thread.
    period_s : float
        Time between two calls.
    callback : callable
        The function.

    """

    def __init__(
        self, node: BaseNode, name: str, period_s: float, callback: Callable[[], object]
    ) -> None:
        self._node = node
        self._period_s = min(period_s, LONGEST_PERIOD_S)
        self._callback = callback
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        end_real_time()
        while not self._stopping.wait(self._period_s):
            with self._node.surviving('a timer'):
                self._callback()


def steady_timer(node: Node, rate_hz: float, callback: Callable[[], None]) -> Timer:
    """Create a timer on the steady clock, which simulated time neither stops nor sets back."""
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    period_s = min(1.0 / rate_hz, LONGEST_PERIOD_S)
    return node.create_timer(period_s, callback, clock=steady)


async def result_of(future: Future[Result], executor: Executor) -> Result:
    """
    Return the result of another thread's future, or raise its error.

    For callbacks: the executor runs other callbacks meanwhile. Saving a large map takes a second;
    a callback that blocked that long would let the queues of the middleware overflow.
    """
    future.add_done_callback(lambda _: executor.wake())
    while not future.done():
        await _next_turn()
    return future.result()


@types.coroutine
def _next_turn() -> Generator[None, None, None]:
    """Yield to other callbacks until the executor wakes up again."""
    yield

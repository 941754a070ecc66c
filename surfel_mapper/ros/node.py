# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node: its life cycle and its parameters, around a session that does the work.

Four threads. The main one makes the transitions and hears signals (running.py). That of the intake
takes clouds and poses and passes them on, the executor's does so with requests and timers. The
mapping thread alone touches the map, and publishes what comes of it.

    unconfigured  parameters and diagnostics
    inactive      kernels are compiled, topics and services are there, no scan is taken
    active        scans are mapped
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import (
    LifecycleNodeMixin,
    LifecycleState,
    TransitionCallbackReturn,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from surfel_mapper.errors import ConfigError, SurfelMapperError
from surfel_mapper.filters.chain import Chain
from surfel_mapper.ros.base_node import BaseNode, result_of
from surfel_mapper.ros.diagnostics import Diagnostics
from surfel_mapper.ros.main_thread import TaskQueue
from surfel_mapper.ros.parameters import as_declared, changed_config, declare_settings, refusal
from surfel_mapper.ros.session import Session

SUCCESS = TransitionCallbackReturn.SUCCESS


class MapperNode(LifecycleNodeMixin, BaseNode):
    """
    A managed node that maps clouds.

    Attributes
    ----------
    tasks : TaskQueue
        What the main thread has to do: transitions that were requested, errors to raise.
    refusal : Exception or None
        Why the last transition was refused.

    Raises
    ------
    ConfigError
        If the user set a parameter that does not exist, or to a value that it cannot have.

    """

    def __init__(self) -> None:
        """Declare the parameters, and offer the services of the life cycle."""
        try:
            Node.__init__(self, 'surfel_mapper')
        except ParameterException as error:  # one of rclpy's own, such as use_sim_time
            raise ConfigError(str(error)) from error
        self.tasks = TaskQueue()
        self.refusal: Exception | None = None
        self._session: Session | None = None
        self._config = declare_settings(self)
        # reentrant, so that a node that compiles still says in which state it is
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._diagnostics = Diagnostics(self, self._config.publish.diagnostics_rate_hz)
        self._lasting = set(self._entities())

    @property
    def autostart(self) -> bool:
        """Whether the node configures and activates itself."""
        return self._config.autostart

    @property
    def state(self) -> str:
        """The name of the state of the life cycle."""
        return str(self._state_machine.current_state[1])

    def start(self) -> None:
        """Configure and activate; raises why if that is refused."""
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != SUCCESS:
                raise self.refusal or RuntimeError(f'{self.state}: the transition failed')

    def end(self) -> None:
        """Shut down from whatever state, even from within a transition that was interrupted."""
        if self.state in ('unconfigured', 'inactive', 'active'):
            self.trigger_shutdown()
        self._release(save=self._config.output.save_on_shutdown)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters that someone sends; the reason of a refusal names what is wrong."""
        if reason := refusal(self, parameter_list):
            return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically([as_declared(p) for p in parameter_list])

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Compile the kernels, then offer topics to read, and services."""
        return self._attempt(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and publish."""
        return self._attempt(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take no more scans, and keep the map."""
        return self._attempt(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Forget the map, and withdraw topics and services."""
        return self._attempt(partial(self._release, save=False))

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End for good; the map is saved first if that is asked for."""
        save = self._config.output.save_on_shutdown
        return self._attempt(partial(self._release, save=save))

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Go back to unconfigured; the main thread ends the node with the error."""
        self._release(save=False)
        return SUCCESS

    def _configure(self) -> None:
        try:
            self._session = Session(self, self._config, self.tasks)
        except BaseException:
            self._withdraw()
            raise
        if self._config != self._session.config:  # changed meanwhile: compiling takes a while
            self._session.reconfigure(self._config)
        self._diagnostics.watch(self._session)

    def _activate(self) -> None:
        session = self._session
        assert session is not None, 'only a configured node is activated'
        session.activate()
        self.get_logger().info(
            f'ready: reads {", ".join(session.inputs.topics())} (pose.source '
            f'{self._config.pose.source}), maps in frame {self._config.frames.fixed} with voxels '
            f'of {self._config.map.voxel_size_m:g} m'
        )

    def _deactivate(self) -> None:
        if self._session is not None:
            self._session.deactivate()

    def _release(self, *, save: bool) -> None:
        """End the session, if there is one."""
        session, self._session = self._session, None
        self._diagnostics.watch(None)
        if session is not None:
            session.deactivate()
            session.close(save=save)
            self._withdraw()

    def _withdraw(self) -> None:
        """Destroy all topics, services and timers that came with a session."""
        for entity, destroy in dict(self._entities()).items():
            if (entity, destroy) not in self._lasting:
                destroy(entity)

    def _entities(self) -> Iterator[tuple[Any, Callable[[Any], Any]]]:
        """Yield everything that others see of the node, and what destroys it."""
        for entities, destroy in (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.publishers, self.destroy_publisher),
            (self.services, self.destroy_service),
        ):
            yield from ((entity, destroy) for entity in entities)

    def _attempt(self, action: Callable[[], object]) -> TransitionCallbackReturn:
        """Carry out a transition; an error that nobody foresaw goes to the main thread."""
        self.refusal = None
        try:
            action()
        except SurfelMapperError as error:
            self.refusal = error
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.refusal = error
            self.tasks.fail(error)
            return TransitionCallbackReturn.ERROR
        return SUCCESS

    async def _on_change_state(
        self, request: ChangeState.Request, response: ChangeState.Response
    ) -> ChangeState.Response:
        """Have the main thread make a transition; one that is not possible is refused."""
        action = partial(self._transit, request, response)
        response.success = await result_of(self.tasks.submit(action), self.executor)
        return response

    def _transit(self, request: ChangeState.Request, response: ChangeState.Response) -> bool:
        """Make a transition that was requested, in the main thread; return whether it was made."""
        name = request.transition.label or str(request.transition.id)
        before, self.refusal = self.state, None
        try:
            done = bool(self._change_state(request, response).success)
        except rclpy_implementation.RCLError:  # no such transition; rclpy lets it end the executor
            done = False
        if not done:
            reason = self.refusal or f'not possible while {before}'
            self.get_logger().error(f'transition {name} refused: {reason}')
        return done

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse values that the configuration refuses, and files that hold no filters."""
        try:
            config = changed_config(self._config, parameters)
            if config.filters and config.filters != self._config.filters:
                Chain.load(config.filters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Put new settings to work, from the next scan on."""
        config = changed_config(self._config, parameters)
        if config != self._config:
            self._config = config
            if self._session is not None:
                self._session.reconfigure(config)

# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The lifecycle node: states, parameters, and the session that does the work.

The main thread makes the transitions and handles signals (main_thread.py). The subscription
executor takes clouds and poses, the rclpy executor requests and timers. Both pass them on. Only
the mapping thread accesses the map, and publishes the results. The heartbeat of the bond and the
diagnostics have a thread each, as a request may take long.

    unconfigured  parameters and diagnostics
    inactive      kernels are compiled, publishers and services exist, no scan is taken
    active        scans are mapped
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import ParameterException
from rclpy.lifecycle import (
    LifecycleNodeMixin,
    LifecycleState,
    TransitionCallbackReturn,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from surfel_mapper.budget import stated_limit
from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, SurfelMapperError
from surfel_mapper.pipeline.scan_poses import standing_sensor
from surfel_mapper.ros.base_node import BaseNode, result_of
from surfel_mapper.ros.bond import Bond
from surfel_mapper.ros.diagnostics import Diagnostics
from surfel_mapper.ros.filter_files import check_chain, FilterFiles
from surfel_mapper.ros.main_thread import TaskQueue
from surfel_mapper.ros.parameters import as_declared, declare_settings, refusals, settings_among
from surfel_mapper.ros.session import Session

SUCCESS = TransitionCallbackReturn.SUCCESS


class MapperNode(LifecycleNodeMixin, BaseNode):
    """
    A lifecycle node that maps clouds.

    Attributes
    ----------
    tasks : TaskQueue
        Tasks for the main thread: requested transitions, and errors to raise.
    refusal : Exception or None
        The reason why the last transition was refused.

    Parameters
    ----------
    ros_args : sequence of str
        The command line; see FilterFiles.

    Raises
    ------
    ConfigError
        If the user set an unknown parameter, or a value out of bounds.

    """

    def __init__(self, ros_args: Sequence[str] = ()) -> None:
        """Declare the parameters and create the services of the life cycle."""
        try:
            Node.__init__(self, 'surfel_mapper')
        except ParameterException as error:  # a parameter of rclpy, such as use_sim_time
            raise ConfigError(str(error)) from error
        self.tasks = TaskQueue()
        self.refusal: Exception | None = None
        self._session: Session | None = None
        self._config = declare_settings(self)
        self._filter_files = FilterFiles(self._config, ros_args)
        # reentrant, so that get_state is answered while kernels compile
        LifecycleNodeMixin.__init__(self, callback_group=ReentrantCallbackGroup())
        self._change_state = self._service_change_state.callback
        self._service_change_state.callback = self._on_change_state
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self._bond = Bond(self)
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

    def report_failure(self, task: str, error: Exception) -> None:
        """Count an error of a callback that nothing expects, in the mapping thread, and log it."""
        session = self._session
        if session is None:
            super().report_failure(task, error)
        else:
            session.thread.report_failure(task, error)

    def start(self) -> None:
        """Configure and activate; raises the reason if refused."""
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != SUCCESS:
                raise self.refusal or RuntimeError(f'{self.state}: the transition failed')

    def end(self) -> None:
        """Shut down from any state, even after an interrupted transition."""
        if self.state in ('unconfigured', 'inactive', 'active'):
            self.trigger_shutdown()
        self._release(save=self._config.output.save_on_shutdown)

    def destroy_node(self) -> None:
        """
        Destroy the node with the services of its life cycle.

        rclpy leaves those to the garbage collector. Until then the middleware's participant and
        its threads live on, and a node of the same name finds a service that does not answer.
        """
        self._diagnostics.stop()
        self._state_machine.destroy_when_not_in_use()
        super().destroy_node()

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Set parameters from a service request; a refusal names the parameter and the reason."""
        parameters = [as_declared(p) for p in parameter_list]
        for reason in refusals(self, parameters).values():
            return SetParametersResult(successful=False, reason=reason)
        return super().set_parameters_atomically(parameters)

    def set_each(self, parameters: Sequence[Parameter]) -> list[SetParametersResult]:
        """
        Set each parameter of a service request that is accepted; return the results.

        Those accepted change the configuration together: at 20 ms for each, 500 would hold all
        other requests for 10 s. If one name comes several times, its last value counts.
        """
        latest = {p.name: as_declared(p) for p in parameters}
        reasons = refusals(self, [*latest.values()])
        accepted = [p for p in latest.values() if p.name not in reasons]
        if not self._check_parameters(accepted).successful:  # conditions on several settings
            candidates, accepted, config = accepted, [], self._config
            for parameter in candidates:
                try:
                    config = self._changed(config, [parameter])
                except ConfigError as error:
                    reasons[parameter.name] = str(error)
                else:
                    accepted.append(parameter)
        result = super().set_parameters_atomically(accepted)
        if not result.successful:
            reasons.update((p.name, result.reason) for p in accepted)
        return [
            SetParametersResult(successful=p.name not in reasons, reason=reasons.get(p.name, ''))
            for p in parameters
        ]

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Compile the kernels, then create publishers and services."""
        return self._attempt(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe and start publishing."""
        return self._attempt(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Unsubscribe; the map stays."""
        return self._attempt(self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard the map, publishers and services."""
        return self._attempt(partial(self._release, save=False))

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard everything; saves the map first if ``output.save_on_shutdown`` is set."""
        save = self._config.output.save_on_shutdown
        return self._attempt(partial(self._release, save=save))

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Return to unconfigured; the main thread ends the node with the error."""
        self._release(save=False)
        return SUCCESS

    def _configure(self) -> None:
        stated_limit()  # else a wrong one would refuse every cloud
        try:
            self._session = Session(self, self._config, self.tasks)
        except BaseException:
            self._withdraw()
            raise
        if self._config != self._session.config:  # changed while kernels compiled
            self._session.reconfigure(self._config)
        self._diagnostics.watch(self._session)

    def _activate(self) -> None:
        session = self._session
        assert session is not None, 'only a configured node is activated'
        session.activate()
        self._bond.start()
        self.get_logger().info(
            f'ready: reads {", ".join(session.inputs.subscriptions.topics())} (pose.source '
            f'{self._config.pose.source}), maps in frame {session.mapper.map_frame} with voxels '
            f'of {self._config.map.voxel_size_m:g} m'
        )
        if self._config.pose.source == 'identity':
            position = standing_sensor(self._config)
            self.get_logger().info(
                'pose.source identity gives no position of the sensor, so normals are not '
                'oriented towards it: their component of largest magnitude is positive; '
                'frames.base_to_sensor gives that of a sensor that does not move'
                if position is None
                else f'normals are oriented towards a sensor that stands at {position.tolist()} m '
                f'in {self._config.frames.fixed}: frames.base_to_sensor with pose.source identity'
            )

    def _deactivate(self) -> None:
        self._bond.stop()
        if self._session is not None:
            self._session.deactivate()

    def _release(self, *, save: bool) -> None:
        """End the session, if there is one."""
        self._bond.stop()
        session, self._session = self._session, None
        self._diagnostics.watch(None)
        if session is not None:
            try:
                session.deactivate()
            finally:
                session.close(save=save)
            self._withdraw()

    def _withdraw(self) -> None:
        """Destroy all publishers, subscriptions, services and timers of a session."""
        for entity, destroy in dict(self._entities()).items():
            if (entity, destroy) not in self._lasting:
                with suppress(ValueError):  # a signal came while rclpy was making it
                    destroy(entity)

    def _entities(self) -> Iterator[tuple[Any, Callable[[Any], Any]]]:
        """
        Yield all timers and endpoints of the node, each with the method that destroys it.

        Without the subscription to /clock: rclpy makes it when use_sim_time is set, never again.
        """
        for entities, destroy in (
            (self.timers, self.destroy_timer),
            (
                (reader for reader in self.subscriptions if reader.msg_type is not Clock),
                self.destroy_subscription,
            ),
            (self.publishers, self.destroy_publisher),
            (self.services, self.destroy_service),
        ):
            yield from ((entity, destroy) for entity in entities)

    def _attempt(self, action: Callable[[], object]) -> TransitionCallbackReturn:
        """Run a transition; an unexpected error goes to the main thread."""
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
        """Pass a transition to the main thread; impossible ones are refused."""
        action = partial(self._transit, request, response)
        response.success = await result_of(self.tasks.submit(action), self.executor)
        return response

    def _transit(self, request: ChangeState.Request, response: ChangeState.Response) -> bool:
        """Make a requested transition, in the main thread; return whether it succeeded."""
        number, label = request.transition.id, request.transition.label
        old_state, self.refusal = self.state, None
        possible = self._state_machine.available_transitions
        done = (label or number) in [transition[bool(label)] for transition in possible]
        if done:  # rcl would write the names of others to the log as they are
            done = bool(self._change_state(request, response).success)
        if not done:
            reason = self.refusal or f'not possible while {old_state}'
            self.get_logger().error(f'transition {label or number} refused: {reason}')
        return done

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse values that the configuration refuses, and invalid filter files."""
        try:
            self._changed(self._config, parameters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """
        Apply new settings from the next scan on.

        Settings come from the services alone, one at a time. The main thread declares parameters
        of rclpy meanwhile, for example those of QoS: it must not write settings back that it has
        read before they changed.
        """
        if not settings_among(parameters):
            return
        config = self._changed(self._config, parameters)
        if config != self._config:
            self._config = config
            if self._session is not None:
                self._session.reconfigure(config)

    def _changed(self, config: Config, parameters: Sequence[Parameter]) -> Config:
        """Return a configuration with changed settings; raise ConfigError if one is refused."""
        changes = settings_among(parameters)
        if isinstance(changes.get('filters'), str):
            changes['filters'] = self._filter_files.path(changes['filters'])
        changed = config.replace(changes)
        if changed.filters and changed.filters != config.filters:
            check_chain(changed.filters)
        return changed

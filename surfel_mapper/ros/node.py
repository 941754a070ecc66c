# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
The node: parameters and services around a Mapper, its inputs and outputs.

Three threads. The main one waits for signals (running.py). The executor's takes messages and
requests and passes them on. The mapping thread alone touches the map, and publishes what comes
of it. A service waits for the mapping thread, behind the clouds that came before the request, so
its answer is about all of them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from functools import partial
import time

from rcl_interfaces.msg import SetParametersResult
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger

from surfel_mapper.config import Config
from surfel_mapper.errors import ConfigError, SurfelMapperError
from surfel_mapper.pipeline import Mapper
from surfel_mapper.ros.inputs import Inputs
from surfel_mapper.ros.mapping_thread import MappingThread
from surfel_mapper.ros.outputs import Outputs
from surfel_mapper.ros.parameters import changed_config, declare_settings
from surfel_mapper.ros.saving import save_map


class MapperNode(Node):
    """
    A node that maps clouds: configure, activate, and close in the end.

    Attributes
    ----------
    failure : Future
        Done when the mapping thread has failed, with the error.

    Raises
    ------
    ConfigError
        If the user set a parameter that does not exist, or to a value that it cannot have.

    """

    def __init__(self) -> None:
        """Declare the parameters."""
        try:
            super().__init__('surfel_mapper')
        except ParameterException as error:  # one of rclpy's own, such as use_sim_time
            raise ConfigError(str(error)) from error
        self.failure: Future[None] = Future()
        self._config = declare_settings(self)

    def configure(self) -> None:
        """
        Compile the kernels, then offer topics to read, and services.

        Raises
        ------
        ConfigError
            If this version cannot do what the settings ask for.

        """
        self._mapper = Mapper(self._config)
        self.get_logger().info('compiling kernels: a moment, or a minute the first time')
        start = time.monotonic()
        self._mapper.warm_up()
        self.get_logger().info(f'kernels ready after {time.monotonic() - start:.1f} s')
        self._thread = MappingThread(self._mapper, self.failure.set_exception)
        self._inputs = Inputs(self, self._config, self._thread)
        self._outputs = Outputs(self, self._mapper, self._thread, self._inputs)
        self._thread.start(self._outputs.publish_update)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        self.create_service(Trigger, '~/clear', self._on_clear)
        self.create_service(Trigger, '~/save_map', self._on_save_map)
        self.create_service(SetBool, '~/pause', self._on_pause)

    def activate(self) -> None:
        """Subscribe and publish; raises what ``Inputs.subscribe`` does."""
        self._inputs.subscribe()
        self._outputs.start_timers(self._config.publish)
        self.get_logger().info(
            f'ready: reads {", ".join(self._inputs.topics())} (pose.source '
            f'{self._config.pose.source}), maps in frame {self._config.frames.fixed} with voxels '
            f'of {self._config.map.voxel_size_m:g} m'
        )

    def deactivate(self) -> None:
        """Take no more messages; those that came are still mapped."""
        self._inputs.unsubscribe()
        self._outputs.stop_timers()

    def close(self) -> None:
        """End the mapping thread when all that came is mapped; log what became of it."""
        self._thread.stop()
        self._mapper.finish()
        self.get_logger().info(report(self._mapper))

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse values that the configuration refuses."""
        try:
            changed_config(self._config, parameters)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        """Put new settings to work, from the next scan on."""
        config = changed_config(self._config, parameters)
        if config != self._config:
            self._config = config
            self._outputs.start_timers(config.publish)
            self._thread.post(partial(self._reconfigure, config))

    def _reconfigure(self, config: Config) -> None:
        """Give the mapper new settings; called in the mapping thread."""
        self._mapper.reconfigure(config)
        self._outputs.expire()

    def _on_clear(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(response, partial(clear, self._mapper))

    def _on_save_map(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return self._answer(response, partial(save_map, self._mapper))

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._thread.paused = request.data
        response.success = True
        response.message = 'paused: clouds are dropped' if request.data else 'mapping'
        return response

    def _answer(self, response: Trigger.Response, action: Callable[[], str]) -> Trigger.Response:
        """Do something in the mapping thread and answer with what it says, or why it failed."""
        try:
            response.message = self._thread.call(action).result()
            response.success = True
            self.get_logger().info(response.message)
        except CancelledError:
            response.message = 'the node is about to end'
        except (SurfelMapperError, OSError) as error:
            response.message = str(error)
            self.get_logger().error(response.message)
        return response


def clear(mapper: Mapper) -> str:
    """Empty the map; return what was in it."""
    message = f'cleared {mapper.map.num_voxels} voxels of {len(mapper.window)} scans'
    mapper.clear()
    return message


def report(mapper: Mapper) -> str:
    """Return in one line what was mapped."""
    summary = mapper.summary()
    scans = summary['scans']
    dropped = ', '.join(f'{cause} {number}' for cause, number in scans['dropped'].items())
    return (
        f'scans received {scans["received"]}, mapped {scans["mapped"]}, '
        f'gated {scans["gated"]}, dropped: {dropped or "none"}; surfels {summary["surfels"]}, '
        f'digest {summary["digest"]}'
    )

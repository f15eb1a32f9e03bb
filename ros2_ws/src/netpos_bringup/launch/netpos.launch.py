"""Start a scenario's graph: ``ros2 launch netpos_bringup netpos.launch.py scenario:=fast_pass``.

For ROS installations that have `launch`; scripts/run_graph.sh starts the same nodes, which
``netpos.scenario.graph`` names, with `ros2 run` alone. The launch ends when the scenario has
ended. With ``bag:=DIR`` the run is recorded.
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from netpos.scenario.graph import SOURCE, run_of

FLUSH_S = 1.0  # the last messages are under way when the simulator ends


def _nodes(context):
    """All nodes; the end of the simulator shuts the rest down."""
    scenario, bag, rate, seed = (
        LaunchConfiguration(name).perform(context) for name in ("scenario", "bag", "rate", "seed")
    )
    started = []
    for node in run_of(scenario, bag, float(rate), int(seed)):
        action = Node(
            package=node.package,
            executable=node.executable,
            name=node.name,
            arguments=list(node.arguments),
            parameters=[dict(node.parameters)] if node.parameters else [],
        )
        started.append(action)
        if node.stage == SOURCE:
            end = EmitEvent(event=Shutdown(reason="the scenario has ended"))
            flush = TimerAction(period=FLUSH_S, actions=[end])
            started.append(
                RegisterEventHandler(OnProcessExit(target_action=action, on_exit=[flush]))
            )
    return started


def generate_launch_description() -> LaunchDescription:
    """Describe recorder, trackers, dead reckoning, RSUs, devices."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("scenario", description="name of a scenario, or a YAML file"),
            DeclareLaunchArgument("seed", default_value="-1", description="-1: the scenario's"),
            DeclareLaunchArgument("rate", default_value="1.0", description="against real time"),
            DeclareLaunchArgument(
                "bag", default_value="", description="folder of a new recording"
            ),
            OpaqueFunction(function=_nodes),
        ]
    )

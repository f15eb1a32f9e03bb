"""Start a scenario's graph: ``ros2 launch netpos_bringup netpos.launch.py scenario:=fast_pass``.

For ROS installations that have `launch`; scripts/run_graph.sh does the same with `ros2 run` alone.
The launch ends when the scenario has ended. With ``bag:=DIR`` the run is recorded.
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from netpos.scenario import load_scenario
from netpos.scenario.settings import settings_from

FLUSH_S = 1.0  # the last messages are under way when the simulator ends


def _trackers(context):
    """One tracker, or one per network of the scenario and the fusion of their tracks."""
    name = LaunchConfiguration("scenario").perform(context)
    scenario = {"scenario": name}
    networks = settings_from(name).networks
    if not networks:
        return [Node(package="ekf_tracker", executable="ekf_tracker", parameters=[scenario])]
    return [
        Node(package="track_fusion", executable="track_fusion", parameters=[scenario]),
        *(
            Node(
                package="ekf_tracker",
                executable="ekf_tracker",
                name=f"ekf_tracker_{network}",
                parameters=[scenario, {"network": network}],
            )
            for network in networks
        ),
    ]


def _dead_reckoning(context):
    """A node for everybody who walks; it waits to be heard, the simulator for it."""
    name = LaunchConfiguration("scenario").perform(context)
    recorded = LaunchConfiguration("bag").perform(context) != ""
    return [
        Node(
            package="pdr_node",
            executable="pdr_node",
            name=f"pdr_{vue}",
            parameters=[{"scenario": name, "vue": vue, "subscribers": 1 + recorded}],
        )
        for vue in load_scenario(name).walkers
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe recorder, tracker, dead reckoning, RSUs, device; its end shuts the rest down."""
    scenario = {"scenario": ParameterValue(LaunchConfiguration("scenario"), value_type=str)}
    seed = {"seed": ParameterValue(LaunchConfiguration("seed"), value_type=int)}
    rate = {"rate": ParameterValue(LaunchConfiguration("rate"), value_type=float)}
    bag = LaunchConfiguration("bag")
    vue_sim = Node(package="vue_sim", executable="vue_sim", parameters=[scenario, seed, rate])
    return LaunchDescription(
        [
            DeclareLaunchArgument("scenario", description="name of a scenario, or a YAML file"),
            DeclareLaunchArgument("seed", default_value="-1", description="-1: the scenario's"),
            DeclareLaunchArgument("rate", default_value="1.0", description="against real time"),
            DeclareLaunchArgument(
                "bag", default_value="", description="folder of a new recording"
            ),
            Node(
                package="netpos_bag",
                executable="record",
                arguments=["--output", bag],
                condition=IfCondition(PythonExpression(["'", bag, "' != ''"])),
            ),
            OpaqueFunction(function=_trackers),
            OpaqueFunction(function=_dead_reckoning),
            Node(package="rsu_sensor", executable="rsu_sensor", parameters=[scenario, seed]),
            vue_sim,
            RegisterEventHandler(
                OnProcessExit(
                    target_action=vue_sim,
                    on_exit=[
                        TimerAction(
                            period=FLUSH_S,
                            actions=[EmitEvent(event=Shutdown(reason="the scenario has ended"))],
                        )
                    ],
                )
            ),
        ]
    )

"""The node of the example for ROS 2, with the controller of a policy and stubs of the headers of ROS."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from support.compilers import NEEDS_C, compile_c, run
from support.controllers import network
from surrogym_sampler.original.classic import pendulum
from surrogym_trainer.deployment.c import write
from surrogym_trainer.deployment.reading import controller_of
from surrogym_trainer.policies.card import read_card, write_card

EXAMPLE = Path(__file__).parents[2] / "examples" / "ros2" / "pendulum_node.cpp"
STUBS = {
    "sensor_msgs/msg/joint_state.hpp": """
#pragma once
#include <vector>
namespace sensor_msgs::msg {
struct JointState { struct { double stamp; } header; std::vector<double> position, velocity; };
}
""",
    "std_msgs/msg/float64.hpp": "namespace std_msgs::msg { struct Float64 { double data; }; }",
    "std_msgs/msg/u_int8.hpp": "#include <cstdint>\nnamespace std_msgs::msg { struct UInt8 { std::uint8_t data; }; }",
    # Time is a number that the test moves, and spin plays the scenes of the test.
    "rclcpp/rclcpp.hpp": """
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include "sensor_msgs/msg/joint_state.hpp"
using sensor_msgs::msg::JointState;
enum { RCL_ROS_TIME };
namespace rclcpp {
inline double clock_now = 100;
inline std::function<void(const JointState &)> heard;
inline std::function<void()> tick;
struct Duration {
  double value;
  static Duration from_seconds(double s) { return {s}; }
  double seconds() { return value; }
};
struct Time { double value; Time(double v) : value(v) {} Time(int, int, int) : value(0) {} };
inline Duration operator-(Time a, Time b) { return {a.value - b.value}; }
struct SensorDataQoS {};
template <class M> struct Subscription { using SharedPtr = std::shared_ptr<Subscription>; };
template <class M> struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  std::string topic;
  void publish(const M &m) { std::printf("%s %g\\n", topic.c_str(), double(m.data)); }
};
struct TimerBase { using SharedPtr = std::shared_ptr<TimerBase>; };
struct Node {
  Node(const char *) {}
  template <class M, class F> std::shared_ptr<Subscription<M>> create_subscription(const char *, SensorDataQoS, F f) {
    heard = f;
    return {};
  }
  template <class M> std::shared_ptr<Publisher<M>> create_publisher(const char *topic, int) {
    return std::make_shared<Publisher<M>>(Publisher<M>{topic});
  }
  int get_clock() { return 0; }
  Time now() { return {clock_now}; }
};
template <class F> TimerBase::SharedPtr create_timer(Node *, int, Duration, F f) { tick = f; return {}; }
inline void init(int, char **) {}
inline void shutdown() {}
inline void spin(std::shared_ptr<Node>) {
  tick();                            // nothing was heard yet
  heard({{100}, {0.5}, {1}}), tick();
  clock_now = 100.09, tick();        // two periods are 0.1 s
  clock_now = 100.11, tick();        // the sensor has stopped
  heard({{100.11}, {}, {}}), tick(); // a message without a joint is no measurement
  heard({{100.2}, {0.5}, {1}}), tick();   // a stamp from the future
  heard({{100.11}, {0.5}, {1e9}}), tick();
}
}
""",
}


@NEEDS_C
@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not on this machine")
def test_the_ros2_node_publishes_the_controllers_status_and_fallback_action(tmp_path: Path):
    for name, content in STUBS.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(content)
    path = network(tmp_path, pendulum(), (8,))
    write_card(path, read_card(path).model_copy(update={"surrogate": "pendulum"}))
    write(controller_of(path), tmp_path)
    built = compile_c("cc", [tmp_path / "pendulum_controller.c"], tmp_path / "controller.o", "-c")
    strict = ["-std=c++17", "-Wall", "-Wextra", "-Werror", f"-I{tmp_path}"]
    subprocess.run(["g++", *strict, EXAMPLE, built, "-lm", "-o", tmp_path / "node"], check=True)
    said = [line.split() for line in run(tmp_path / "node").splitlines()]
    assert [beat for topic, beat in said if topic == "heartbeat"] == ["4", "0", "0", "4", "4", "4", "2"]
    torques = [float(torque) for topic, torque in said if topic == "torque"]
    assert [torque != 0 for torque in torques] == [False, True, True, False, False, False, False]

// A ROS 2 node around a controller that `surrogym deploy POLICY --target c` wrote: copy it into a package with the header and
// the source of the controller. The controller is called in a timer of the sampling period and not in the callback of the
// sensor, so that a sensor that stops leads to the fallback. A test compiles it with stubs of the ROS headers, not with ROS.
#include <memory>

#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>
#include <std_msgs/msg/float64.hpp>
#include <std_msgs/msg/u_int8.hpp>

#include "pendulum_controller.h"

using sensor_msgs::msg::JointState;
using std_msgs::msg::Float64;
using std_msgs::msg::UInt8;

class PendulumNode : public rclcpp::Node {
 public:
  PendulumNode() : rclcpp::Node("pendulum_controller") {
    pendulum_reset(&controller_);
    sensor_ = create_subscription<JointState>("joint_states", rclcpp::SensorDataQoS(), [this](const JointState &joint) {
      if (joint.position.empty() || joint.velocity.empty()) return;
      measurement_[0] = joint.position[0];  // the header's order and units
      measurement_[1] = joint.velocity[0];
      stamp_ = joint.header.stamp;  // when it was measured: the latency of the network counts as age
      seen_ = true;
    });
    motor_ = create_publisher<Float64>("torque", 1);
    heartbeat_ = create_publisher<UInt8>("heartbeat", 1);
    timer_ = rclcpp::create_timer(this, get_clock(), rclcpp::Duration::from_seconds(0.05), [this] { decide(); });
  }

 private:
  void decide() {
    Float64 torque;
    UInt8 beat;  // the motor's driver stops if no beat comes for two periods
    const double age = seen_ ? (now() - stamp_).seconds() : -1;
    beat.data = static_cast<std::uint8_t>(pendulum_step(&controller_, measurement_, age, action_));
    torque.data = action_[0];
    motor_->publish(torque);
    heartbeat_->publish(beat);
  }

  pendulum_controller controller_;
  pendulum_real measurement_[PENDULUM_MEASUREMENTS] = {};
  pendulum_real action_[PENDULUM_ACTIONS] = {};
  rclcpp::Time stamp_{0, 0, RCL_ROS_TIME};
  bool seen_ = false;
  rclcpp::Subscription<JointState>::SharedPtr sensor_;
  rclcpp::Publisher<Float64>::SharedPtr motor_;
  rclcpp::Publisher<UInt8>::SharedPtr heartbeat_;
  rclcpp::TimerBase::SharedPtr timer_;
};

int main(int count, char **arguments) {
  rclcpp::init(count, arguments);
  rclcpp::spin(std::make_shared<PendulumNode>());
  rclcpp::shutdown();
}

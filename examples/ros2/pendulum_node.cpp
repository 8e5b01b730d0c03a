// The heart of a ROS 2 node around a controller that `surrogym deploy POLICY --target c` wrote: copy it into a package with
// the three files of the controller. No test compiles it. The controller is called in a timer of the sampling period and not
// in the callback of the sensor, so that a sensor that stops leads to the fallback.

Node() : rclcpp::Node("pendulum_controller") {
  pendulum_reset(&controller_);
  sensor_ = create_subscription<JointState>("joint_states", rclcpp::SensorDataQoS(), [this](const JointState &joint) {
    measurement_[0] = joint.position[0];  // the header's order and units
    measurement_[1] = joint.velocity[0];
    seen_ = true;
    stamp_ = joint.header.stamp;          // when it was measured: the latency of the network counts as age
  });
  motor_ = create_publisher<Float64>("torque", 1);
  heartbeat_ = create_publisher<UInt8>("heartbeat", 1);
  timer_ = rclcpp::create_timer(this, get_clock(), rclcpp::Duration::from_seconds(0.05), [this] { decide(); });
}

void decide() {
  Float64 torque;
  UInt8 beat;  // the motor's driver stops if no beat comes for two periods
  beat.data = pendulum_step(&controller_, measurement_, seen_ ? (now() - stamp_).seconds() : -1, action_);
  torque.data = action_[0];
  motor_->publish(torque);
  heartbeat_->publish(beat);
}

// What a program that balances needs of a robot: samples of its sensors, and servos.
//
// Joints are in the order of the policy (mjxb_joint_name): abduction, hip and knee of each leg.
// Units: rad, rad/s, m/s^2, N m, s. Axes: x forward, y left, z up.
#ifndef ROBOT_HPP
#define ROBOT_HPP

#include <stdexcept>

constexpr int JOINTS = 12;

struct Sensors {
    double time;              // of a clock that never goes back, s
    float joints[JOINTS];     // angles, rad
    float gyro[3];            // rad/s
    float accelerometer[3];   // m/s^2; about (0, 0, 9.81) at rest
    float quaternion[4];      // of the trunk in the world, w first
    float torques[JOINTS];    // of the servos, N m
    bool damped;              // the robot's own watchdog has taken over
};

// torque = stiffness * (position - angle) - damping * rate + feed-forward torque
struct Targets {
    double position[JOINTS];   // rad
    double stiffness[JOINTS];  // N m / rad
    double damping[JOINTS];    // N m s / rad
    double torque[JOINTS];     // feed-forward, N m
};

class Robot {
public:
    virtual ~Robot() = default;
    // Waits for the next sample. False: there will be none.
    virtual bool read(Sensors &sensors) = 0;
    // What the servos do until the next call.
    virtual void write(const Targets &targets) = 0;
};

// A sentence for the user.
struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

#endif

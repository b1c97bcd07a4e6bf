// A robot on a tilting board in MuJoCo, as the evaluation in Python has it.
#ifndef SIMULATED_ROBOT_HPP
#define SIMULATED_ROBOT_HPP

#include <chrono>
#include <deque>
#include <map>
#include <memory>
#include <random>
#include <string>
#include <vector>

#include <mujoco/mujoco.h>

#include "robot.hpp"

using Clock = std::chrono::steady_clock;

// Model, start and board motions that scene.py writes.
class Scene {
public:
    explicit Scene(const std::string &path);
    // Values of a record; each is a row of `count` records, of episode `row`.
    const double *row(const std::string &name, int row, std::size_t size) const;
    std::vector<int> ids(const std::string &name) const;
    double number(const std::string &name) const { return *row(name, 0, 1); }

    int episodes, steps;  // physics steps of an episode
    int first;            // step from which on the tilt counts
    std::shared_ptr<mjModel> model;

private:
    std::map<std::string, std::vector<double>> values_;
};

class SimulatedRobot : public Robot {
public:
    // An episode of the scene; real_time: `read` waits until the sample is due.
    SimulatedRobot(const Scene &scene, int episode, bool real_time);
    bool read(Sensors &sensors) override;
    void write(const Targets &targets) override;

    const char *joint_name(int joint) const;
    Clock::time_point due() const;         // when the sample after the last one is due
    Targets damping() const;               // soft legs that sink slowly
    // After each step from scene.first on, deg.
    std::vector<double> tilts() const;
    bool fell() const { return fell_; }

private:
    void obey(const Targets &targets);
    void measure();
    Clock::time_point at(double time) const;

    const Scene &scene_;
    const int episode_;
    const bool real_time_;
    std::shared_ptr<mjModel> model_;  // a copy: commands change its gains
    std::shared_ptr<mjData> data_;
    std::vector<int> qpos_, dofs_, servos_, board_, imu_;
    int trunk_;                       // of the trunk's quaternion in qpos
    std::vector<double> nominal_damping_, tilts_;
    std::deque<Targets> pending_;     // commands on their way to the servos
    std::size_t delay_;               // of commands, steps
    double fall_;                     // tilt of a fall, deg
    const double *noise_;             // of gyro, rad/s, and accelerometer, m/s^2
    std::mt19937 random_;
    std::normal_distribution<double> normal_;
    bool fell_ = false;
    Clock::time_point began_;
};

#endif

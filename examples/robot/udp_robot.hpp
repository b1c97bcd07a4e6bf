// A robot at the other end of a UDP connection.
#ifndef UDP_ROBOT_HPP
#define UDP_ROBOT_HPP

#include <chrono>
#include <string>

#include "packet.hpp"

class UdpRobot : public Robot {
public:
    // robot_clock: a sample's time is that of the robot, not of its arrival here. For a robot that
    // waits for every command, whose time is not ours.
    UdpRobot(const std::string &host, const std::string &port, bool robot_clock);
    // False: the robot has been silent for 2 s, or 20 s if it waits for us.
    bool read(Sensors &sensors) override;
    void write(const Targets &targets) override;

    // Packets: taken; not after the last one; damaged, or none of ours.
    long taken = 0, old = 0, garbage = 0;

private:
    void hello();
    double now() const;

    Socket socket_;
    const bool robot_clock_;
    const double silence_;  // s
    const std::chrono::steady_clock::time_point began_ = std::chrono::steady_clock::now();
    std::uint32_t sequence_ = 0, last_ = 0;
};

#endif

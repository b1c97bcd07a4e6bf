#include "udp_robot.hpp"

#include <algorithm>

namespace {

constexpr double HELLO = 0.1;  // s from one hello to the next

}

UdpRobot::UdpRobot(const std::string &host, const std::string &port, bool robot_clock)
    : socket_(host, port), robot_clock_(robot_clock), silence_(robot_clock ? 20.0 : 2.0)
{
}

double UdpRobot::now() const
{
    return std::chrono::duration<double>(std::chrono::steady_clock::now() - began_).count();
}

void UdpRobot::hello()
{
    std::uint8_t bytes[MOST_BYTES];
    const std::size_t size = encode({Kind::hello, false, ++sequence_, 0, now()}, bytes);
    socket_.send(bytes, size);
}

bool UdpRobot::read(Sensors &sensors)
{
    const double began = now();
    double said_hello = -HELLO;
    for (double passed = 0; passed < silence_; passed = now() - began) {
        if (taken == 0 && passed - said_hello >= HELLO) {
            hello();
            said_hello = passed;
        }
        std::uint8_t bytes[MOST_BYTES];
        Socket::Address from;
        const double wait = std::min(taken == 0 ? HELLO : silence_, silence_ - passed);
        const long size = socket_.receive(bytes, sizeof bytes, wait, from);
        if (size < 0) {
            continue;
        }
        Header header;
        Targets none;
        Sensors sample;
        if (!decode(bytes, static_cast<std::size_t>(size), header, sample, none) ||
            header.kind != Kind::state) {
            ++garbage;
        } else if (taken > 0 && !newer(header.sequence, last_)) {
            ++old;
        } else {
            ++taken;
            last_ = header.sequence;
            sensors = sample;
            sensors.time = robot_clock_ ? header.time : now();
            return true;
        }
    }
    return false;
}

void UdpRobot::write(const Targets &targets)
{
    std::uint8_t bytes[MOST_BYTES];
    const Header header = {Kind::command, false, ++sequence_, last_, now()};
    socket_.send(bytes, encode(header, targets, bytes));
}

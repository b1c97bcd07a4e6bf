// A robot on a tilting board in MuJoCo, at the other end of UDP.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

#include "packet.hpp"
#include "simulated_robot.hpp"

namespace {

const char USAGE[] =
    "usage: fake_robot PORT [--scene FILE] [--scenario K] [--lockstep] [--everywhere]\n"
    "\n"
    "PORT          where it listens, 0: any free one; its time begins with the first hello\n"
    "--scene       what scene.py has written; scene.bin beside this program\n"
    "--scenario    0\n"
    "--lockstep    no real time: it waits for the command that answers each sample\n"
    "--everywhere  listen at all addresses of this machine, not only at the loopback\n";

constexpr std::uint32_t WATCHDOG = 12;  // samples, 48 ms: if the last answered one is older, it damps
constexpr double SILENCE = 20.0;        // s after which a robot in lockstep gives up

class Server {
public:
    Server(std::uint16_t port, bool everywhere, const Targets &damping)
        : socket_(port, everywhere), damping_(damping)
    {
    }

    int port() const { return socket_.port(); }

    // Waits for a controller's hello.
    void wait()
    {
        while (!greeted_) {
            take(3600.0);
        }
    }

    void send(const Sensors &sensors)
    {
        std::uint8_t bytes[MOST_BYTES];
        ++sequence_;
        const Header header = {Kind::state, damped_, sequence_, last_, sensors.time};
        socket_.send(bytes, encode(header, sensors, bytes), &controller_);
    }

    // Takes packets until the next sample is due, or, in lockstep, until the command comes.
    bool receive(Clock::time_point due, bool lockstep)
    {
        const auto until = lockstep ? Clock::now() + std::chrono::duration_cast<Clock::duration>(
                                                         std::chrono::duration<double>(SILENCE))
                                    : due;
        while (!(lockstep && answered_ == sequence_)) {
            const std::chrono::duration<double> left = until - Clock::now();
            take(left.count());
            if (left.count() <= 0) {
                return !lockstep;
            }
        }
        return true;
    }

    // What the servos do now: the command, or damping.
    Targets targets()
    {
        // Also if commands come, but answer states of long ago, or of the future.
        if (sequence_ - answered_ > WATCHDOG) {
            damped_ = true;
        }
        return damped_ || !commanded_ ? damping_ : command_;
    }

    void report() const
    {
        std::printf("packets: %ld taken, %ld old, %ld garbage, %ld of others%s\n", taken_, old_,
                    garbage_, others_, damped_ ? "; damped by the watchdog" : "");
    }

private:
    void take(double seconds)
    {
        std::uint8_t bytes[MOST_BYTES];
        Socket::Address from;
        const long size = socket_.receive(bytes, sizeof bytes, seconds, from);
        if (size < 0) {
            return;
        }
        Header header;
        Sensors none;
        Targets targets;
        if (!decode(bytes, static_cast<std::size_t>(size), header, none, targets) ||
            header.kind == Kind::state) {
            ++garbage_;
        } else if (greeted_ && !(from == controller_)) {
            ++others_;
        } else if (header.kind == Kind::hello) {
            controller_ = from;
            greeted_ = true;
            last_ = newer(header.sequence, last_) ? header.sequence : last_;
        } else if (!greeted_ || !newer(header.sequence, last_)) {
            ++old_;
        } else {
            ++taken_;
            last_ = header.sequence;
            answered_ = header.answers;
            command_ = targets;
            commanded_ = true;
        }
    }

    Socket socket_;
    const Targets damping_;
    Targets command_ = {};
    Socket::Address controller_;
    bool greeted_ = false, commanded_ = false, damped_ = false;
    std::uint32_t sequence_ = 0, last_ = 0, answered_ = 0;
    long taken_ = 0, old_ = 0, garbage_ = 0, others_ = 0;
};

int serve(std::uint16_t port, const std::string &path, int scenario, bool lockstep,
          bool everywhere)
{
    const Scene scene(path);
    Server server(port, everywhere, SimulatedRobot(scene, scenario, false).damping());
    std::printf("listening at port %d\n", server.port());
    std::fflush(stdout);
    server.wait();
    SimulatedRobot robot(scene, scenario, !lockstep);
    Sensors sensors;
    while (robot.read(sensors)) {
        server.send(sensors);
        if (!server.receive(robot.due(), lockstep)) {
            break;
        }
        robot.write(server.targets());
    }
    server.report();
    const std::vector<double> tilts = robot.tilts();
    double sum = 0, greatest = 0;
    for (const double tilt : tilts) {
        sum += tilt;
        greatest = std::max(greatest, tilt);
    }
    std::printf("%s after %.3f s; tilt in deg: mean %.6f, greatest %.6f\n",
                robot.fell() ? "fallen" : "upright", sensors.time,
                tilts.empty() ? 0.0 : sum / static_cast<double>(tilts.size()), greatest);
    return robot.fell() ? 1 : 0;
}

}  // namespace

int main(int count, char **arguments)
{
    std::vector<std::string> numbers;
    const std::string self = arguments[0];
    std::string scene = self.substr(0, self.find_last_of('/') + 1) + "scene.bin", scenario = "0";
    bool lockstep = false, everywhere = false, good = true;
    for (int k = 1; k < count; ++k) {
        const std::string argument = arguments[k];
        const bool more = k + 1 < count;
        if (argument == "--lockstep") {
            lockstep = true;
        } else if (argument == "--everywhere") {
            everywhere = true;
        } else if (argument == "--scene" && more) {
            scene = arguments[++k];
        } else if (argument == "--scenario" && more) {
            scenario = arguments[++k];
        } else {
            numbers.push_back(argument);
        }
    }
    good = numbers.size() == 1;
    numbers.push_back(scenario);
    for (const std::string &number : numbers) {
        good = good && !number.empty() && number.size() <= 5 &&
               number.find_first_not_of("0123456789") == std::string::npos;
    }
    if (!good || std::stoi(numbers[0]) > 65535) {
        std::fputs(USAGE, stderr);
        return 2;
    }
    try {
        return serve(static_cast<std::uint16_t>(std::stoi(numbers[0])), scene,
                     std::stoi(scenario), lockstep, everywhere);
    } catch (const Error &error) {
        std::fprintf(stderr, "fake_robot: %s\n", error.what());
        return 2;
    }
}

// Balances a robot with an exported policy: in MuJoCo, or over UDP.
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <string>
#include <vector>

#include "policy.h"  // mjx-balance export POLICY --out policy.h
#include "simulated_robot.hpp"
#include "udp_robot.hpp"

static_assert(MJXB_JOINTS == JOINTS, "the policy's robot must have four legs");
static_assert(MJXB_HAS_GAINS && MJXB_HAS_TRIM, "the policy must know gains: export it with --trim");

namespace {

const char USAGE[] =
    "usage: balance sim [--scene FILE] [--fast] [--stand-up]\n"
    "       balance udp HOST PORT [--seconds S] [--stand-up] [--lockstep]\n"
    "\n"
    "sim         every scenario of a scene that scene.py has written, in real time\n"
    "udp         a robot at the other end of a network, until it is silent\n"
    "--scene     what scene.py has written; scene.bin beside this program\n"
    "--fast      as fast as the simulation runs\n"
    "--stand-up  the servos obey gains: stand up first, and damp after a fault\n"
    "--seconds   end after so many seconds of samples\n"
    "--lockstep  the robot waits for every command; its time counts\n";

class Balancer {
public:
    explicit Balancer(bool stand_up) : stand_up_(stand_up)
    {
        mjxb_options options = mjxb_default_options();
        options.gains = stand_up;
        mjxb_init(&controller_, &options);
    }

    // Runs the loop, for so many samples at most; returns the last state.
    mjxb_state run(Robot &robot, long samples)
    {
        Sensors sensors = {};
        for (long k = 0; k < samples && robot.read(sensors); ++k) {
            const mjxb_state before = controller_.state;
            if (k == 1 && stand_up_) {
                mjxb_stand(&controller_);  // here stands the button
            }
            step(sensors);
            robot.write(targets());
            if (controller_.state != before) {
                report(sensors.time);
            }
        }
        return controller_.state;
    }

private:
    void step(const Sensors &sensors)
    {
        mjxb_sample sample = {};
        sample.time = sensors.time;
        std::memcpy(sample.joints, sensors.joints, sizeof sample.joints);
        std::memcpy(sample.gyro, sensors.gyro, sizeof sample.gyro);
        std::memcpy(sample.accelerometer, sensors.accelerometer, sizeof sample.accelerometer);
        sample.quaternion = sensors.quaternion;
        sample.torques = sensors.torques;
        mjxb_step(&controller_, &sample);
        if (sensors.damped && controller_.state != MJXB_PASSIVE) {
            mjxb_damp(&controller_);  // it sinks: stiff legs would jerk it up again
        }
    }

    Targets targets() const
    {
        Targets targets = {};
        std::memcpy(targets.position, controller_.out.position, sizeof targets.position);
        std::memcpy(targets.stiffness, controller_.out.stiffness, sizeof targets.stiffness);
        std::memcpy(targets.damping, controller_.out.damping, sizeof targets.damping);
        std::memcpy(targets.torque, controller_.out.torque, sizeof targets.torque);
        return targets;
    }

    void report(double time) const
    {
        static const char *const names[] = {"STANDING", "BALANCING",   "HOLDING",
                                            "PASSIVE",  "STANDING_UP", "DAMPING"};
        std::printf("%.3f s: %s", time, names[controller_.state]);
        if (controller_.fault != MJXB_NONE) {
            std::printf(", %s: %g", mjxb_reason(controller_.fault), controller_.fault_value);
        }
        std::printf("\n");
        std::fflush(stdout);
    }

    mjxb_controller controller_;
    const bool stand_up_;
};

void check_joints(const SimulatedRobot &robot)
{
    for (int k = 0; k < JOINTS; ++k) {
        const std::string expected = mjxb_joint_name(k / 3, k % 3), name = robot.joint_name(k);
        if (name != expected) {
            throw Error("joint " + std::to_string(k) + " of the scene is " + name +
                        ", but the policy's is " + expected);
        }
    }
}

int simulate(const std::string &path, bool fast, bool stand_up)
{
    const Scene scene(path);
    std::vector<double> tilts;
    int falls = 0;
    bool balancing = true;
    for (int episode = 0; episode < scene.episodes; ++episode) {
        SimulatedRobot robot(scene, episode, !fast);
        check_joints(robot);
        std::printf("scenario %d\n", episode);
        balancing = Balancer(stand_up).run(robot, scene.steps) == MJXB_BALANCING && balancing;
        const std::vector<double> own = robot.tilts();
        tilts.insert(tilts.end(), own.begin(), own.end());
        falls += robot.fell() ? 1 : 0;
    }
    double sum = 0;
    for (const double tilt : tilts) {
        sum += tilt;
    }
    std::printf("%d of %d fell; tilt in deg: mean %.6f, greatest %.6f\n", falls, scene.episodes,
                sum / static_cast<double>(tilts.size()),
                *std::max_element(tilts.begin(), tilts.end()));
    return balancing && falls == 0 ? 0 : 1;
}

int connect(const std::string &host, const std::string &port, double seconds, bool stand_up,
            bool lockstep)
{
    UdpRobot robot(host, port, lockstep);
    const long samples = std::lround(seconds / MJXB_SAMPLE_S);
    const mjxb_state state = Balancer(stand_up).run(robot, samples);
    if (robot.taken == 0) {
        throw Error("no robot answers at " + host + ":" + port);
    }
    std::printf("packets: %ld taken, %ld old, %ld garbage\n", robot.taken, robot.old,
                robot.garbage);
    if (robot.taken < samples) {
        std::fprintf(stderr, "balance: the robot is silent\n");
        return 1;
    }
    return state == MJXB_BALANCING ? 0 : 1;
}

}  // namespace

int main(int count, char **arguments)
{
    std::vector<std::string> places;
    const std::string self = arguments[0];
    std::string scene = self.substr(0, self.find_last_of('/') + 1) + "scene.bin";
    double seconds = 1e6;
    bool fast = false, stand_up = false, lockstep = false, good = true;
    for (int k = 1; k < count; ++k) {
        const std::string argument = arguments[k];
        const bool more = k + 1 < count;
        if (argument == "--fast") {
            fast = true;
        } else if (argument == "--stand-up") {
            stand_up = true;
        } else if (argument == "--lockstep") {
            lockstep = true;
        } else if (argument == "--scene" && more) {
            scene = arguments[++k];
        } else if (argument == "--seconds" && more) {
            char *end = nullptr;
            seconds = std::strtod(arguments[++k], &end);
            good = good && *end == '\0' && seconds > 0 && seconds <= 1e6;
        } else {
            good = good && argument.compare(0, 1, "-") != 0;
            places.push_back(argument);
        }
    }
    try {
        if (good && places.size() == 1 && places[0] == "sim") {
            return simulate(scene, fast, stand_up);
        }
        if (good && places.size() == 3 && places[0] == "udp") {
            return connect(places[1], places[2], seconds, stand_up, lockstep);
        }
    } catch (const Error &error) {
        std::fprintf(stderr, "balance: %s\n", error.what());
        return 2;
    }
    std::fputs(USAGE, stderr);
    return 2;
}

#include "simulated_robot.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <fstream>
#include <thread>

Scene::Scene(const std::string &path)
{
    std::ifstream file(path, std::ios::binary);
    std::string name;
    std::size_t bytes = 0;
    while (file >> name >> bytes && file.get() == '\n') {
        std::vector<char> content(bytes);
        if (!file.read(content.data(), static_cast<std::streamsize>(bytes))) {
            break;
        }
        if (name == "model") {
            model.reset(mj_loadModelBuffer(content.data(), static_cast<mjtSize>(bytes)),
                        mj_deleteModel);
        } else {
            std::vector<double> &values = values_[name];
            values.resize(bytes / sizeof(double));
            std::memcpy(values.data(), content.data(), values.size() * sizeof(double));
        }
    }
    if (!file.eof() || !model || !values_.count("end")) {
        throw Error(path + " is no scene of this version of MuJoCo (" + mj_versionString() +
                    "); write it with scene.py");
    }
    episodes = static_cast<int>(number("episodes"));
    steps = static_cast<int>(number("steps"));
    first = static_cast<int>(number("first"));
}

const double *Scene::row(const std::string &name, int row, std::size_t size) const
{
    const auto found = values_.find(name);
    const std::size_t begin = static_cast<std::size_t>(row) * size;
    if (found == values_.end() || row < 0 || begin + size > found->second.size()) {
        throw Error("the scene has no " + name + " " + std::to_string(row));
    }
    return found->second.data() + begin;
}

std::vector<int> Scene::ids(const std::string &name) const
{
    const auto found = values_.find(name);
    if (found == values_.end()) {
        throw Error("the scene has no " + name);
    }
    return std::vector<int>(found->second.begin(), found->second.end());
}

SimulatedRobot::SimulatedRobot(const Scene &scene, int episode, bool real_time)
    : scene_(scene), episode_(episode), real_time_(real_time),
      model_(mj_copyModel(nullptr, scene.model.get()), mj_deleteModel),
      data_(mj_makeData(model_.get()), mj_deleteData),
      qpos_(scene.ids("leg_qpos")), dofs_(scene.ids("leg_dofs")),
      servos_(scene.ids("leg_servos")), board_(scene.ids("board_servos")),
      imu_(scene.ids("imu")), trunk_(static_cast<int>(scene.number("trunk_quat"))),
      delay_(static_cast<std::size_t>(scene.number("command_delay"))),
      fall_(scene.number("fail_tilt")), noise_(scene.row("imu_noise", 0, 2)), random_(static_cast<unsigned>(episode)),
      began_(Clock::now())
{
    if (qpos_.size() != JOINTS) {
        throw Error("the scene's robot has " + std::to_string(qpos_.size()) + " joints, not 12");
    }
    const auto copy = [&](const char *name, mjtNum *out, int row, mjtSize size) {
        std::copy_n(scene.row(name, row, static_cast<std::size_t>(size)), size, out);
    };
    copy("qpos", data_->qpos, episode, model_->nq);
    copy("qvel", data_->qvel, 0, model_->nv);
    copy("qacc_warmstart", data_->qacc_warmstart, 0, model_->nv);
    copy("ctrl", data_->ctrl, 0, model_->nu);
    const double *imu = scene.row("still", episode, imu_.size());
    for (std::size_t k = 0; k < imu_.size(); ++k) {
        data_->sensordata[imu_[k]] = imu[k];
    }
    for (const int dof : dofs_) {
        nominal_damping_.push_back(model_->dof_damping[dof]);
    }
}

const char *SimulatedRobot::joint_name(int joint) const
{
    const int servo = servos_[static_cast<std::size_t>(joint)];
    const char *name = mj_id2name(model_.get(), mjOBJ_JOINT, model_->actuator_trnid[2 * servo]);
    const char *slash = std::strrchr(name, '/');
    return slash == nullptr ? name : slash + 1;
}

Clock::time_point SimulatedRobot::at(double time) const
{
    const std::chrono::duration<double> since(time);
    return began_ + std::chrono::duration_cast<Clock::duration>(since);
}

Clock::time_point SimulatedRobot::due() const
{
    return at(data_->time + model_->opt.timestep);
}

std::vector<double> SimulatedRobot::tilts() const
{
    const auto begin = std::min(tilts_.size(), static_cast<std::size_t>(scene_.first));
    return {tilts_.begin() + static_cast<std::ptrdiff_t>(begin), tilts_.end()};
}

Targets SimulatedRobot::damping() const
{
    Targets targets = {};
    std::copy_n(nominal_damping_.begin(), JOINTS, targets.damping);
    return targets;
}

bool SimulatedRobot::read(Sensors &sensors)
{
    if (fell_ || tilts_.size() == static_cast<std::size_t>(scene_.steps)) {
        return false;
    }
    if (real_time_) {
        std::this_thread::sleep_until(at(data_->time));
    }
    // As MuJoCo leaves them after a step: the IMU's sample is of the state before it.
    sensors = {};
    sensors.time = data_->time;
    for (std::size_t k = 0; k < JOINTS; ++k) {
        sensors.joints[k] = static_cast<float>(data_->qpos[qpos_[k]]);
        sensors.torques[k] = static_cast<float>(data_->actuator_force[servos_[k]]);
    }
    for (std::size_t k = 0; k < 3; ++k) {
        const double gyro = data_->sensordata[imu_[k]] + noise_[0] * normal_(random_);
        const double accel = data_->sensordata[imu_[3 + k]] + noise_[1] * normal_(random_);
        sensors.gyro[k] = static_cast<float>(gyro);
        sensors.accelerometer[k] = static_cast<float>(accel);
    }
    for (int k = 0; k < 4; ++k) {
        sensors.quaternion[k] = static_cast<float>(data_->qpos[trunk_ + k]);
    }
    return true;
}

void SimulatedRobot::write(const Targets &targets)
{
    pending_.push_back(targets);
    if (pending_.size() > delay_) {
        obey(pending_.front());
        pending_.pop_front();
    }
    const std::size_t axes = board_.size();
    const int row = episode_ * scene_.steps + static_cast<int>(tilts_.size());
    const double *board = scene_.row("board", row, axes);
    for (std::size_t k = 0; k < axes; ++k) {
        data_->ctrl[board_[k]] = board[k];
    }
    mj_step(model_.get(), data_.get());
    measure();
}

// MuJoCo's position servo as one whose gains come with every command.
void SimulatedRobot::obey(const Targets &targets)
{
    for (std::size_t k = 0; k < JOINTS; ++k) {
        mjtNum *gain = model_->actuator_gainprm + servos_[k] * mjNGAIN;
        mjtNum *bias = model_->actuator_biasprm + servos_[k] * mjNBIAS;
        gain[0] = targets.stiffness[k];
        bias[0] = targets.torque[k];
        bias[1] = -targets.stiffness[k];
        model_->dof_damping[dofs_[k]] = targets.damping[k];
        data_->ctrl[servos_[k]] = targets.position[k];
    }
}

void SimulatedRobot::measure()
{
    const mjtNum *quaternion = data_->qpos + trunk_;
    const double half_sine = std::min(std::hypot(quaternion[1], quaternion[2]), 1.0);
    const double tilt = 2.0 * 180.0 / mjPI * std::asin(half_sine);
    bool diverged = false;
    for (int k = 0; k < mjNWARNING; ++k) {
        diverged = diverged || data_->warning[k].number > 0;
    }
    const bool counts = tilts_.size() >= static_cast<std::size_t>(scene_.first);
    if (diverged || (counts && !(tilt <= fall_))) {  // NaN, too
        // From a fall to the end of the episode the tilt counts as that of a fall.
        fell_ = true;
        tilts_.resize(static_cast<std::size_t>(scene_.steps), fall_);
    } else {
        tilts_.push_back(tilt);
    }
}

#include "packet.hpp"

#include <cerrno>
#include <cmath>
#include <cstring>

#include <netdb.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

namespace {

constexpr std::uint8_t MAGIC[4] = {'M', 'J', 'X', 'B'};
constexpr std::uint8_t VERSION = 1;
constexpr std::size_t HEADER = 24, CRC = 4;
constexpr std::size_t STATE = HEADER + 4 * (2 * JOINTS + 3 + 3 + 4) + CRC;
constexpr std::size_t COMMAND = HEADER + 4 * 4 * JOINTS + CRC;
static_assert(COMMAND == MOST_BYTES - 1 && STATE < COMMAND, "docs/without_python.md says so");

std::size_t size_of(Kind kind)
{
    return kind == Kind::hello ? HEADER + CRC : kind == Kind::state ? STATE : COMMAND;
}

// CRC-32 of IEEE 802.3, as zlib's crc32.
std::uint32_t crc32(const std::uint8_t *bytes, std::size_t size)
{
    std::uint32_t crc = 0xffffffffu;
    for (std::size_t k = 0; k < size; ++k) {
        crc ^= bytes[k];
        for (int bit = 0; bit < 8; ++bit) {
            crc = (crc >> 1) ^ ((crc & 1u) != 0 ? 0xedb88320u : 0u);
        }
    }
    return ~crc;
}

// Little-endian values one after another, whatever this machine's order is.
class Writer {
public:
    explicit Writer(std::uint8_t *bytes) : at_(bytes) {}
    void integer(std::uint64_t value, int bytes)
    {
        for (int k = 0; k < bytes; ++k) {
            *at_++ = static_cast<std::uint8_t>(value >> (8 * k));
        }
    }
    void real64(double value)
    {
        std::uint64_t bits;
        std::memcpy(&bits, &value, sizeof bits);
        integer(bits, 8);
    }
    template <typename T, std::size_t N> void real32(const T (&values)[N])
    {
        for (const T value : values) {
            const float narrow = static_cast<float>(value);
            std::uint32_t bits;
            std::memcpy(&bits, &narrow, sizeof bits);
            integer(bits, 4);
        }
    }
    std::uint8_t *at_;
};

class Reader {
public:
    explicit Reader(const std::uint8_t *bytes) : at_(bytes) {}
    std::uint64_t integer(int bytes)
    {
        std::uint64_t value = 0;
        for (int k = 0; k < bytes; ++k) {
            value |= static_cast<std::uint64_t>(*at_++) << (8 * k);
        }
        return value;
    }
    double real64()
    {
        const std::uint64_t bits = integer(8);
        double value;
        std::memcpy(&value, &bits, sizeof value);
        return value;
    }
    template <typename T, std::size_t N> void real32(T (&values)[N])
    {
        for (T &value : values) {
            const auto bits = static_cast<std::uint32_t>(integer(4));
            float narrow;
            std::memcpy(&narrow, &bits, sizeof narrow);
            value = narrow;
        }
    }
    const std::uint8_t *at_;
};

Writer begin(const Header &header, std::uint8_t *bytes)
{
    std::memcpy(bytes, MAGIC, sizeof MAGIC);
    Writer writer(bytes + sizeof MAGIC);
    writer.integer(VERSION, 1);
    writer.integer(static_cast<std::uint8_t>(header.kind), 1);
    writer.integer(JOINTS, 1);
    writer.integer(header.damped ? 1 : 0, 1);
    writer.integer(header.sequence, 4);
    writer.integer(header.answers, 4);
    writer.real64(header.time);
    return writer;
}

std::size_t end(Writer &writer, const std::uint8_t *bytes)
{
    const auto size = static_cast<std::size_t>(writer.at_ - bytes);
    writer.integer(crc32(bytes, size), CRC);
    return size + CRC;
}

bool sane(const Targets &targets)
{
    for (int k = 0; k < JOINTS; ++k) {
        const double gains[2] = {targets.stiffness[k], targets.damping[k]};
        if (!(gains[0] >= 0 && gains[1] >= 0 && std::isfinite(gains[0] + gains[1])) ||
            !std::isfinite(targets.position[k]) || !std::isfinite(targets.torque[k])) {
            return false;
        }
    }
    return true;
}

}  // namespace

std::size_t encode(const Header &header, std::uint8_t *bytes)
{
    Writer writer = begin(header, bytes);
    return end(writer, bytes);
}

std::size_t encode(const Header &header, const Sensors &sensors, std::uint8_t *bytes)
{
    Writer writer = begin(header, bytes);
    writer.real32(sensors.joints);
    writer.real32(sensors.gyro);
    writer.real32(sensors.accelerometer);
    writer.real32(sensors.quaternion);
    writer.real32(sensors.torques);
    return end(writer, bytes);
}

std::size_t encode(const Header &header, const Targets &targets, std::uint8_t *bytes)
{
    Writer writer = begin(header, bytes);
    writer.real32(targets.position);
    writer.real32(targets.stiffness);
    writer.real32(targets.damping);
    writer.real32(targets.torque);
    return end(writer, bytes);
}

bool decode(const std::uint8_t *bytes, std::size_t size, Header &header, Sensors &sensors,
            Targets &targets)
{
    if (size < HEADER + CRC || size > COMMAND || std::memcmp(bytes, MAGIC, sizeof MAGIC) != 0 ||
        bytes[4] != VERSION || bytes[5] > static_cast<std::uint8_t>(Kind::command) ||
        bytes[6] != JOINTS || bytes[7] > 1 || size != size_of(static_cast<Kind>(bytes[5])) ||
        Reader(bytes + size - CRC).integer(CRC) != crc32(bytes, size - CRC)) {
        return false;
    }
    header.kind = static_cast<Kind>(bytes[5]);
    header.damped = bytes[7] != 0;
    Reader reader(bytes + 8);
    header.sequence = static_cast<std::uint32_t>(reader.integer(4));
    header.answers = static_cast<std::uint32_t>(reader.integer(4));
    header.time = reader.real64();
    if (header.kind == Kind::state) {
        reader.real32(sensors.joints);
        reader.real32(sensors.gyro);
        reader.real32(sensors.accelerometer);
        reader.real32(sensors.quaternion);
        reader.real32(sensors.torques);
        sensors.time = header.time;
        sensors.damped = header.damped;
    } else if (header.kind == Kind::command) {
        reader.real32(targets.position);
        reader.real32(targets.stiffness);
        reader.real32(targets.damping);
        reader.real32(targets.torque);
        return sane(targets);
    }
    return true;
}

Socket::Socket(std::uint16_t port, bool everywhere)
{
    sockaddr_in address = {};
    address.sin_family = AF_INET;
    address.sin_port = htons(port);
    address.sin_addr.s_addr = htonl(everywhere ? INADDR_ANY : INADDR_LOOPBACK);
    file_ = socket(AF_INET, SOCK_DGRAM, 0);
    if (file_ < 0 || bind(file_, reinterpret_cast<sockaddr *>(&address), sizeof address) != 0) {
        throw Error("port " + std::to_string(port) + " cannot be used: " + std::strerror(errno));
    }
}

Socket::Socket(const std::string &host, const std::string &port)
{
    addrinfo hints = {}, *found = nullptr;
    hints.ai_family = AF_INET;
    hints.ai_socktype = SOCK_DGRAM;
    const int error = getaddrinfo(host.c_str(), port.c_str(), &hints, &found);
    if (error != 0) {
        throw Error(host + ":" + port + " is no address: " + gai_strerror(error));
    }
    file_ = socket(found->ai_family, found->ai_socktype, found->ai_protocol);
    const bool connected = file_ >= 0 && connect(file_, found->ai_addr, found->ai_addrlen) == 0;
    freeaddrinfo(found);
    if (!connected) {
        throw Error(host + ":" + port + " cannot be reached: " + std::strerror(errno));
    }
}

Socket::~Socket()
{
    close(file_);
}

int Socket::port() const
{
    sockaddr_in address = {};
    socklen_t size = sizeof address;
    getsockname(file_, reinterpret_cast<sockaddr *>(&address), &size);
    return ntohs(address.sin_port);
}

bool Socket::Address::operator==(const Address &other) const
{
    return size == other.size && std::memcmp(bytes, other.bytes, size) == 0;
}

long Socket::receive(std::uint8_t *bytes, std::size_t size, double seconds, Address &from)
{
    static_assert(sizeof from.bytes >= sizeof(sockaddr_storage), "any address fits");
    const auto whole = static_cast<time_t>(seconds > 0 ? seconds : 0);
    const double rest = seconds > 0 ? seconds - static_cast<double>(whole) : 0;
    const timespec wait = {whole, static_cast<long>(1e9 * rest)};
    pollfd ready = {file_, POLLIN, 0};
    if (ppoll(&ready, 1, &wait, nullptr) <= 0) {
        return -1;
    }
    socklen_t length = sizeof from.bytes;
    // An error here is that of an earlier packet: nobody listens there yet.
    const long count = recvfrom(file_, bytes, size, MSG_DONTWAIT,
                                reinterpret_cast<sockaddr *>(from.bytes), &length);
    from.size = length;
    return count;
}

void Socket::send(const std::uint8_t *bytes, std::size_t size, const Address *to)
{
    const auto *address = to == nullptr ? nullptr : reinterpret_cast<const sockaddr *>(to->bytes);
    (void)sendto(file_, bytes, size, MSG_DONTWAIT, address, to == nullptr ? 0 : to->size);
}

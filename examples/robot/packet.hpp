// Packets between a robot and its controller: docs/without_python.md has the table.
#ifndef PACKET_HPP
#define PACKET_HPP

#include <cstddef>
#include <cstdint>
#include <string>

#include "robot.hpp"

enum class Kind : std::uint8_t { hello = 0, state = 1, command = 2 };

struct Header {
    Kind kind = Kind::hello;
    bool damped = false;          // of a state: the robot's watchdog has taken over
    std::uint32_t sequence = 0;   // of this sender's packets, from 1 on
    std::uint32_t answers = 0;    // sequence of the other side's last packet
    double time = 0;              // of the sender's clock, s
};

// Greatest packet, and one byte more: what is longer than any packet is seen to be.
constexpr std::size_t MOST_BYTES = 220 + 1;

// Write a packet and return its size in bytes.
std::size_t encode(const Header &header, std::uint8_t *bytes);
std::size_t encode(const Header &header, const Sensors &sensors, std::uint8_t *bytes);
std::size_t encode(const Header &header, const Targets &targets, std::uint8_t *bytes);

// Whether the bytes are a whole, undamaged packet. Of a state it fills `sensors`, of a command
// `targets`.
bool decode(const std::uint8_t *bytes, std::size_t size, Header &header, Sensors &sensors,
            Targets &targets);

// Whether a sequence number comes after another one; they begin again at 2^32.
inline bool newer(std::uint32_t a, std::uint32_t b)
{
    return a != b && a - b < 0x80000000u;
}

// A UDP socket.
class Socket {
public:
    // Listens at a port of the loopback, or of all addresses; 0: any free port.
    Socket(std::uint16_t port, bool everywhere);
    // Exchanges packets with a peer, and with nobody else.
    Socket(const std::string &host, const std::string &port);
    ~Socket();
    Socket(const Socket &) = delete;
    Socket &operator=(const Socket &) = delete;

    struct Address {
        alignas(8) unsigned char bytes[128] = {};
        unsigned size = 0;
        bool operator==(const Address &other) const;
    };

    int port() const;  // of this end
    // Waits up to `seconds` for a datagram; its size, or -1.
    long receive(std::uint8_t *bytes, std::size_t size, double seconds, Address &from);
    // To a connected peer, or to an address. What cannot be sent is lost, as on the way.
    void send(const std::uint8_t *bytes, std::size_t size, const Address *to = nullptr);

private:
    int file_ = -1;
};

#endif

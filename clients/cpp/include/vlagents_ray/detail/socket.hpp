// TCP with deadlines.
#pragma once

#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "vlagents_ray/error.hpp"

namespace vlagents_ray::detail {

using Clock = std::chrono::steady_clock;

/// A moment by which something must have happened; by default, never.
class Deadline {
 public:
  Deadline() = default;

  static Deadline in(double seconds) {
    Deadline found;
    const double bounded = std::clamp(seconds, 0.0, 1e6);
    found.at_ = Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(bounded));
    return found;
  }

  /// Seconds, at least 0.
  double left() const {
    return at_ ? std::max(0.0, std::chrono::duration<double>(*at_ - Clock::now()).count()) : 1e6;
  }

  bool over() const { return at_ && Clock::now() >= *at_; }
  const std::optional<Clock::time_point>& at() const { return at_; }

  /// The earlier one of this and `seconds` from now.
  Deadline within(double seconds) const { return left() < seconds ? *this : in(seconds); }

  /// Milliseconds for poll(2).
  int poll_ms() const { return at_ ? static_cast<int>(std::min(left() * 1000 + 1, 1e9)) : -1; }

 private:
  std::optional<Clock::time_point> at_;
};

/// A connected TCP socket. One thread may send while another one receives; `shut` wakes both.
class Socket {
 public:
  /// Connect to the first address of `host` that answers. The look-up of a name has the system's own time limit.
  static Socket connect(const std::string& host, const std::string& port, const Deadline& deadline) {
    addrinfo hints{};
    hints.ai_family = AF_UNSPEC;
    hints.ai_socktype = SOCK_STREAM;
    addrinfo* first = nullptr;
    if (const int failed = ::getaddrinfo(host.c_str(), port.c_str(), &hints, &first); failed != 0)
      throw Error("unavailable", host + ": " + ::gai_strerror(failed));
    const std::unique_ptr<addrinfo, decltype(&::freeaddrinfo)> addresses(first, &::freeaddrinfo);
    std::string reason = "no address";
    for (const addrinfo* each = first; each != nullptr; each = each->ai_next) {
      Socket found(::socket(each->ai_family, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, each->ai_protocol));
      if (found.handle_ < 0) {
        reason = std::strerror(errno);
        continue;
      }
      int error = ::connect(found.handle_, each->ai_addr, each->ai_addrlen) == 0 ? 0 : errno;
      if (error == EINPROGRESS || error == EINTR) {
        if (!found.wait(POLLOUT, deadline)) {
          reason = "no connection in time";
          continue;
        }
        socklen_t size = sizeof error;
        if (::getsockopt(found.handle_, SOL_SOCKET, SO_ERROR, &error, &size) != 0) error = errno;
      }
      if (error == 0) {
        const int on = 1;
        ::setsockopt(found.handle_, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
        ::setsockopt(found.handle_, SOL_SOCKET, SO_KEEPALIVE, &on, sizeof on);
        return found;
      }
      reason = std::strerror(error);
    }
    throw Error("unavailable", host + ":" + port + ": " + reason + "; is the server there, and does a firewall let it through?");
  }

  Socket(Socket&& other) noexcept : handle_(std::exchange(other.handle_, -1)) {}
  Socket& operator=(Socket&&) = delete;
  ~Socket() {
    if (handle_ >= 0) ::close(handle_);
  }

  /// Send all of it, or throw: "connection_lost", or "outcome_unknown" at the deadline.
  void send(const std::uint8_t* data, std::size_t size, const Deadline& deadline) const {
    while (size > 0) {
      const ssize_t sent = ::send(handle_, data, size, MSG_NOSIGNAL);
      if (sent >= 0) {
        data += sent;
        size -= static_cast<std::size_t>(sent);
      } else if (errno == EAGAIN || errno == EWOULDBLOCK) {
        if (!wait(POLLOUT, deadline)) throw Error("outcome_unknown", "the server did not read the request in time");
      } else if (errno != EINTR) {
        throw Error("connection_lost", std::string("while sending: ") + std::strerror(errno));
      }
    }
  }

  /// Receive at least one byte, or throw likewise. 0: the other end closed the connection.
  std::size_t receive(std::uint8_t* data, std::size_t size, const Deadline& deadline) const {
    while (true) {
      const ssize_t got = ::recv(handle_, data, size, 0);
      if (got >= 0) return static_cast<std::size_t>(got);
      if (errno == EAGAIN || errno == EWOULDBLOCK) {
        if (!wait(POLLIN, deadline)) throw Error("outcome_unknown", "no answer in time");
      } else if (errno != EINTR) {
        throw Error("connection_lost", std::string("while receiving: ") + std::strerror(errno));
      }
    }
  }

  void shut() const noexcept { ::shutdown(handle_, SHUT_RDWR); }

 private:
  explicit Socket(int handle) : handle_(handle) {}

  bool wait(short events, const Deadline& deadline) const {
    while (true) {
      pollfd asked{handle_, events, 0};
      const int ready = ::poll(&asked, 1, deadline.poll_ms());
      if (ready > 0) return true;
      if (ready == 0 && deadline.over()) return false;
      if (ready < 0 && errno != EINTR) throw Error("connection_lost", std::string("poll: ") + std::strerror(errno));
    }
  }

  int handle_;
};

}  // namespace vlagents_ray::detail

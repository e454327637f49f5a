// A WebSocket of the server, whose replies a thread hands to the calls that wait for them.
#pragma once

#include <condition_variable>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include "vlagents_ray/detail/frames.hpp"
#include "vlagents_ray/detail/websocket.hpp"

namespace vlagents_ray::detail {

/// One connection. The thread answers pings also while no call waits, and ends with the connection.
class Connection {
 public:
  Connection(const Url& url, const std::string& path, const Headers& headers, const Deadline& deadline)
      : socket_(url, path, headers, deadline), thread_([this] { receive(); }) {}

  Connection(const Connection&) = delete;
  Connection& operator=(const Connection&) = delete;

  ~Connection() {
    socket_.say_close();
    socket_.shut();
    thread_.join();
  }

  /// Send a request, and wait for the reply with its `request_id`. An error of the connection is thrown here.
  Frame call(const Request& request, const std::string& request_id, const Deadline& deadline) {
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      if (failure_) throw *failure_;
      waiting_.emplace(request_id, std::nullopt);
    }
    try {
      socket_.send([&](Bytes& message) { encode_frame(request, message); }, deadline);
    } catch (const Error&) {
      const std::lock_guard<std::mutex> guard(mutex_);
      waiting_.erase(request_id);
      throw;
    }
    std::unique_lock<std::mutex> lock(mutex_);
    wait(lock, deadline, [&] { return waiting_.at(request_id) || failure_; });
    std::optional<Frame> reply = std::move(waiting_.at(request_id));
    waiting_.erase(request_id);
    if (reply) return std::move(*reply);
    if (failure_) throw *failure_;
    throw Error("outcome_unknown", "the server did not answer in time; it may have executed the request");
  }

  /// Ask the server for a sign of life that reaches neither a session nor the policy.
  void probe(const Deadline& deadline) {
    const char text[] = "VLA?\0\0\0";
    socket_.send([&](Bytes& message) { message.insert(message.end(), text, text + sizeof text); }, deadline);
  }

  /// How many messages came so far.
  std::uint64_t received() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return received_;
  }

  /// Does a further message come in time, or has one come since there were `before`?
  bool more_than(std::uint64_t before, const Deadline& deadline) {
    std::unique_lock<std::mutex> lock(mutex_);
    wait(lock, deadline, [&] { return received_ > before || failure_; });
    return received_ > before;
  }

  bool broken() const {
    const std::lock_guard<std::mutex> guard(mutex_);
    return failure_.has_value();
  }

 private:
  template <typename True>
  void wait(std::unique_lock<std::mutex>& lock, const Deadline& deadline, True&& is_true) {
    if (deadline.at())
      changed_.wait_until(lock, *deadline.at(), is_true);
    else
      changed_.wait(lock, is_true);
  }

  void receive() noexcept {
    try {
      while (true) {
        const Bytes message = socket_.receive(Deadline());
        const bool probed = message.size() >= 4 && std::memcmp(message.data(), "VLA!", 4) == 0;
        deliver(probed ? Frame() : decode_frame(message));
      }
    } catch (const Error& error) {
      const bool silent = error.code() == "outcome_unknown";  // it did not read the answer to a ping
      fail(silent ? Error("connection_lost", error.detail()) : error);
    } catch (const std::exception& error) {
      fail(Error("malformed", error.what()));
    }
  }

  void deliver(Frame reply) {
    const auto request_id = text_at(reply.header, "request_id");
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      ++received_;
      if (request_id) {
        const auto found = waiting_.find(*request_id);
        if (found != waiting_.end()) found->second = std::move(reply);  // else its call has given up
      } else if (reply.header.contains("error")) {  // of no request that the server could read, or of the connection
        for (auto& [_, waited] : waiting_) waited = reply;
      }
    }
    changed_.notify_all();  // a call that wakes up finds the mutex free
  }

  void fail(Error error) noexcept {
    socket_.shut();
    const std::lock_guard<std::mutex> guard(mutex_);
    failure_ = std::move(error);
    changed_.notify_all();
  }

  WebSocket socket_;
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::map<std::string, std::optional<Frame>> waiting_;
  std::optional<Error> failure_;
  std::uint64_t received_ = 0;
  std::thread thread_;  // last: it uses all of the above
};

}  // namespace vlagents_ray::detail

// A client of vlagents_ray's policy server: docs/protocol.md over a WebSocket.
#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>

#include "vlagents_ray/detail/connection.hpp"
#include "vlagents_ray/detail/messages.hpp"
#include "vlagents_ray/error.hpp"
#include "vlagents_ray/types.hpp"

namespace vlagents_ray {

struct Options {
  std::string url;                // "http://gpu-box:8000", with the application's prefix if it has one
  std::string api_key;            // sent as `Authorization: Bearer KEY`; "" sends none
  double timeout_s = 30.0;        // what one call may take, reconnecting included; 2 to 5 for a robot
  int jpeg_quality = 90;          // 1 to 100 of raw images, colours at full resolution; 0 sends raw pixels
  bool resume = true;             // begin the session again where its connection was lost
  std::size_t history = 16;       // observations kept for that, unless the policy's contract needs fewer; at most 256
  std::string priority = "robot"; // or "simulation", which robots go before
  std::string session;            // 1 to 128 visible ASCII characters; "" makes a UUID
  Json contract;                  // what the robot gives and takes; the server compares it with the policy's
};

/// One robot's session. Calls of several threads wait for each other.
class Client {
 public:
  /// Connects to nothing: the first call does.
  explicit Client(Options options) : options_(std::move(options)), url_(detail::Url::parse(options_.url)) {
    if (!(options_.timeout_s > 0)) throw Error("invalid_input", "timeout_s: expected more than 0 seconds");
    if (options_.jpeg_quality < 0 || options_.jpeg_quality > 100) throw Error("invalid_input", "jpeg_quality: expected 0 to 100");
    options_.history = std::min<std::size_t>(options_.history, 256);
    session_ = options_.session.empty() ? detail::new_uuid() : options_.session;
    if (!options_.api_key.empty()) headers_["authorization"] = "Bearer " + options_.api_key;
  }

  explicit Client(const std::string& url) : Client(with_url(url)) {}

  /// Policy, contract and addresses of the server (`GET /v1/metadata`).
  Json metadata() const {
    return detail::get_json(url_, "/v1/metadata", headers_, detail::Deadline::in(options_.timeout_s));
  }

  /// Begin an episode.
  /// @param kwargs options of the policy, such as {"seed": 3}
  /// @return what the policy says of it
  /// @throws Error with the server's `code`, or one of the client's
  Json reset(const Observation& obs, const std::string& instruction, Json kwargs = Json::object()) {
    const std::lock_guard<std::mutex> guard(mutex_);
    const auto deadline = detail::Deadline::in(options_.timeout_s);
    episode_ = detail::Episode{detail::prepared(obs, options_.jpeg_quality), instruction, std::move(kwargs), {}};
    begun_ = false;
    step_.reset();
    if (draining_ || !answers(deadline)) drop();
    const bool fresh = connection_ == nullptr;
    try {
      return begin(deadline);
    } catch (const Error& error) {
      if (fresh || !options_.resume || error.code() != "connection_lost") throw;
    }
    drop();
    return begin(deadline);
  }

  /// One action or chunk for an observation.
  ///
  /// If the connection was lost, or the server has lost the session, it begins again with the same instruction, the
  /// first observation and the last ones, and `Act::resumed` is true. No action of the lost session is ever returned.
  /// @throws Error "not_reset" before `reset`; "outcome_unknown" if no answer came in time, after which the next
  ///   observation may follow; others with the server's `code`
  Act act(const Observation& obs) {
    const std::lock_guard<std::mutex> guard(mutex_);
    if (!begun_) throw Error("not_reset", "call reset with the first observation and the instruction");
    const auto deadline = detail::Deadline::in(options_.timeout_s);
    Observation sent = detail::prepared(obs, options_.jpeg_quality, std::exchange(spare_, {}));
    const detail::Request request = detail::act_request(sent);
    bool resumed = false;
    if (!answers(deadline)) drop();
    if (connection_ == nullptr && !options_.resume)
      throw Error("connection_lost", "the session ended with its connection; call reset");
    if (connection_ != nullptr && draining_) move(deadline);
    for (double pause_s = 0.05;; pause_s = std::min(2 * pause_s, 1.0)) {
      bool acting = connection_ != nullptr;
      try {
        if (!acting) {
          begin(deadline);
          resumed = acting = true;
        }
        const detail::Frame reply = exchange(request, deadline);
        Act act = detail::decode_act(reply);
        act.resumed = resumed;
        remember(std::move(sent));
        return act;
      } catch (const Error& error) {
        const std::string& code = error.code();
        const bool lost = code == "connection_lost" || (acting && code == "unknown_session");
        const bool absent = !acting && (code == "unavailable" || code == "no_replica" || code == "overloaded");
        if (lost || !acting) drop();  // a session that has not begun again must not act
        if (!options_.resume || !(lost || absent)) throw;
        pause_s = std::max(pause_s, error.retry_after_s().value_or(0.0));
        if (deadline.left() <= pause_s) throw;
      }
      std::this_thread::sleep_for(std::chrono::duration<double>(pause_s));
    }
  }

  /// End the session and the connection. A server that cannot be reached ends the session by itself.
  void close() noexcept {
    try {
      const std::lock_guard<std::mutex> guard(mutex_);
      if (begun_ && connection_ != nullptr && !connection_->broken()) {
        detail::Request request;
        request.header["op"] = "close";
        exchange(std::move(request), detail::Deadline::in(std::min(options_.timeout_s, 1.0)));
      }
    } catch (const std::exception&) {  // the session ends with the connection
    }
    const std::lock_guard<std::mutex> guard(mutex_);
    begun_ = false;
    drop();
  }

  double timeout_s() const noexcept { return options_.timeout_s; }

 private:
  static Options with_url(const std::string& url) {
    Options options;
    options.url = url;
    return options;
  }

  static constexpr double direct_s = 2.0;  // to establish a connection to the replica's own port
  static constexpr std::size_t most_history = detail::max_message / 2;  // bytes: a reset with them is one message
  static constexpr double life_s = 1.0;    // for a sign of life, after a call without an answer

  /// A connection to where the metadata says by now: the replica's own port, or the server's.
  std::unique_ptr<detail::Connection> open(const detail::Deadline& deadline) {
    detail::Headers headers = headers_;
    headers["x-boot-id"] = "server";  // the metadata of the replica with the least load
    const Json metadata = detail::get_json(url_, "/v1/metadata", headers, deadline);
    const auto version = detail::number_at(metadata, "protocol", 1000);
    if (version && *version != detail::protocol_version)
      throw Error("malformed", "expected version 1 of the protocol, got " + std::to_string(*version) + "; update the client");
    const auto wanted = detail::number_at(detail::object_at(metadata, "contract"), "history", options_.history);
    kept_ = wanted ? static_cast<std::size_t>(*wanted) : options_.history;
    const Json stream = detail::object_at(metadata, "stream");
    const auto port = detail::number_at(stream, "port", 65535);
    const auto path = detail::text_at(stream, "path");
    if (port && path && path->rfind('/', 0) == 0) {
      detail::Url direct = url_;
      direct.port = std::to_string(*port);
      try {
        return std::make_unique<detail::Connection>(direct, *path, headers_, deadline.within(direct_s));
      } catch (const Error&) {  // a firewall, or a tunnel of one port: the server's own port may do
      }
    }
    return std::make_unique<detail::Connection>(url_, url_.prefix + "/v1/stream", headers_, deadline);
  }

  /// Reset the session for the episode, over a new connection if there is none.
  Json begin(const detail::Deadline& deadline) {
    if (connection_ == nullptr) {
      connection_ = open(deadline);
      if (options_.session.empty()) session_ = detail::new_uuid();  // the server may not have noticed yet that the old one ended
    }
    step_.reset();
    const detail::Frame reply = exchange(detail::reset_request(episode_, options_.contract), deadline);
    begun_ = true;
    return detail::resolved(detail::object_at(reply.header, "info"), reply.blobs);
  }

  /// Go on over a new connection, as this replica stops or has too many sessions. If there is none, stay.
  void move(const detail::Deadline& deadline) {
    try {
      auto next = open(deadline.within(std::max(direct_s, deadline.left() / 2)));
      left_ = std::exchange(connection_, std::move(next));
      draining_ = false;
    } catch (const Error&) {  // the replica still answers; the next act tries again
    }
  }

  /// Is the connection usable? After a call without any message of the server's, it must show a sign of life.
  bool answers(const detail::Deadline& deadline) {
    if (connection_ == nullptr || connection_->broken()) return false;
    if (!silent_since_) return true;
    const std::uint64_t before = *std::exchange(silent_since_, std::nullopt);
    return connection_->more_than(before, deadline.within(std::min(life_s, deadline.left() / 4)));
  }

  detail::Frame exchange(detail::Request request, const detail::Deadline& deadline) {
    const std::string request_id = std::to_string(++requests_);
    const double left_s = deadline.left();
    if (left_s < 0.001) throw Error("deadline_exceeded", "no time was left to send the request");
    request.header["session"] = session_;
    request.header["request_id"] = request_id;
    request.header["priority"] = options_.priority;
    request.header["deadline_ms"] = 900 * left_s;  // the server's own error arrives in time
    if (step_) request.header["step"] = *step_;
    const std::uint64_t before = connection_->received();
    detail::Frame reply;
    try {
      reply = connection_->call(request, request_id, deadline);
    } catch (const Error& error) {
      if (error.code() == "outcome_unknown") unanswered(before);
      throw;
    }
    left_.reset();
    const auto drains = reply.header.find("draining");
    draining_ = drains != reply.header.end() && drains->is_boolean() && drains->get<bool>();
    const auto step = detail::text_at(reply.header, "step");
    const auto stated = reply.header.find("error");
    if (step) step_ = step;
    if (stated == reply.header.end()) return reply;
    const Error error = detail::stated_error(*stated, "internal", "the server states no reason");
    if (error.code() == "outcome_unknown" && !step) step_.reset();
    throw error;
  }

  /// The session may have taken the step: its number is not known, and is sent again only after the next reply.
  void unanswered(std::uint64_t before) {
    step_.reset();
    if (connection_->broken() || connection_->received() > before) return;
    silent_since_ = before;
    try {
      connection_->probe(detail::Deadline::in(0.1));
    } catch (const Error&) {  // `answers` finds it broken
    }
  }

  void remember(Observation obs) {
    episode_.later.push_back(std::move(obs));
    std::size_t bytes = detail::size_of(episode_.first);
    for (const Observation& each : episode_.later) bytes += detail::size_of(each);
    while (!episode_.later.empty() && (episode_.later.size() > kept_ || bytes > most_history)) {
      bytes -= detail::size_of(episode_.later.front());
      spare_ = std::move(episode_.later.front());
      episode_.later.pop_front();
    }
  }

  void drop() noexcept {
    connection_.reset();
    left_.reset();
    draining_ = false;
    silent_since_.reset();
  }

  Options options_;
  detail::Url url_;
  detail::Headers headers_;
  std::mutex mutex_;
  std::unique_ptr<detail::Connection> connection_;
  std::unique_ptr<detail::Connection> left_;  // a draining replica's, until the next one answers
  detail::Episode episode_;
  Observation spare_;  // one that is no longer kept: the next one is written over it
  std::string session_;
  std::optional<std::string> step_;
  std::optional<std::uint64_t> silent_since_;  // messages received when a call was not answered at all
  std::uint64_t requests_ = 0;
  std::size_t kept_ = 0;  // observations for a session that begins again: as many as the policy's contract looks at
  bool begun_ = false;
  bool draining_ = false;
};

}  // namespace vlagents_ray

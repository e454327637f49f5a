// The one exception of this client.
#pragma once

#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

namespace vlagents_ray {

/// What went wrong, with the stable `code` of docs/troubleshooting.md.
///
/// The server's codes arrive as they are. The client itself raises
///   "unavailable"        the server cannot be reached, or rejected the connection,
///   "connection_lost"    the connection broke during a request, which may have been executed,
///   "deadline_exceeded"  no time was left before the request was sent, so it was not executed,
///   "outcome_unknown"    no answer came in time: the request may have been executed, or may still be,
///   "too_large"          a message over its limit, before it is sent or while it is received,
///   "malformed"          the server answered with what the protocol does not allow,
///   "invalid_action"     an action with NaN or infinity, or of a shape that is none,
///   "invalid_input"      an argument that cannot be sent.
class Error : public std::runtime_error {
 public:
  /// @param code one of docs/troubleshooting.md
  /// @param detail the expected value, the given value and the cure, in English
  /// @param retry_after_s seconds after which the same request is worth another try, of 429 and 503
  Error(std::string code, const std::string& detail, std::optional<double> retry_after_s = std::nullopt)
      : std::runtime_error(code + ": " + detail),
        code_(std::move(code)),
        detail_(detail),
        retry_after_s_(retry_after_s) {}

  const std::string& code() const noexcept { return code_; }
  const std::string& detail() const noexcept { return detail_; }
  std::optional<double> retry_after_s() const noexcept { return retry_after_s_; }

 private:
  std::string code_;
  std::string detail_;
  std::optional<double> retry_after_s_;
};

}  // namespace vlagents_ray

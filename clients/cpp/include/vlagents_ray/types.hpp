// What a policy sees and what it answers.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "vlagents_ray/error.hpp"

namespace vlagents_ray {

using Json = nlohmann::json;
using Bytes = std::vector<std::uint8_t>;

/// One camera's picture: raw pixels, or a JPEG or PNG file as a camera may give it.
struct Image {
  Bytes data;              // RGB, one byte each, rows from the top; or the bytes of a file
  std::size_t height = 0;  // pixels; 0 of a file
  std::size_t width = 0;   // pixels; 0 of a file

  bool is_file() const noexcept { return height == 0; }

  /// @param pixels height * width * 3 bytes, RGB
  static Image rgb(Bytes pixels, std::size_t height, std::size_t width) {
    if (height == 0 || width == 0 || height > 65535 || width > 65535 || pixels.size() != height * width * 3)
      throw Error("invalid_input", "image: expected height * width * 3 bytes for " + std::to_string(height) + " x " +
                                       std::to_string(width) + " pixels, got " + std::to_string(pixels.size()));
    return Image{std::move(pixels), height, width};
  }

  /// @param bytes a JPEG or PNG file
  static Image file(Bytes bytes) {
    if (bytes.empty()) throw Error("invalid_input", "image: expected a JPEG or PNG file, got an empty one");
    return Image{std::move(bytes), 0, 0};
  }
};

/// What the robot observes at one moment.
struct Observation {
  std::map<std::string, Image> cameras;
  std::optional<double> gripper;                    // 0 is closed, 1 is open
  std::map<std::string, std::vector<float>> state;  // such as "joints", in the units of the policy's contract
  Json info = Json::object();                       // anything else
};

/// What the policy answers.
struct Act {
  std::vector<float> values;  // the rows, one after the other
  std::size_t rows = 1;       // H, actions to be executed one after the other
  std::size_t dim = 0;        // D, numbers of one action
  bool chunk = false;         // false: the policy answered with one action, of shape [D]
  bool done = false;          // the policy considers the task finished
  bool resumed = false;       // the session was begun again before this act, as its connection was lost
  Json info = Json::object();
  Json timing = Json::object();  // milliseconds, as docs/protocol.md names them

  /// @param number from 0 to rows - 1
  std::vector<float> row(std::size_t number) const {
    if (number >= rows)
      throw Error("invalid_input", "row: expected less than " + std::to_string(rows) + ", got " + std::to_string(number));
    const auto begin = values.begin() + static_cast<std::ptrdiff_t>(number * dim);
    return {begin, begin + static_cast<std::ptrdiff_t>(dim)};
  }
};

}  // namespace vlagents_ray

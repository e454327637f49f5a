// Requests and replies of the protocol as frames.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <deque>
#include <iterator>
#include <random>
#include <string>
#include <utility>
#include <vector>

#include "vlagents_ray/detail/frames.hpp"
#include "vlagents_ray/detail/jpeg.hpp"

namespace vlagents_ray::detail {

/// The observation with its raw images as JPEG files; as it is if `quality` is 0.
/// @param spare an observation that nobody needs any more, whose memory is used again: fresh pages cost more than copying
inline Observation prepared(const Observation& obs, int quality, Observation spare = {}) {
  Observation copy = std::move(spare);
  for (auto at = copy.cameras.begin(); at != copy.cameras.end();)
    at = obs.cameras.count(at->first) == 0 ? copy.cameras.erase(at) : std::next(at);
  for (const auto& [name, image] : obs.cameras) {
    if (image.data.empty() || (!image.is_file() && image.data.size() != image.height * image.width * 3))
      throw Error("invalid_input", "camera '" + name + "': expected Image::rgb or Image::file");
    copy.cameras[name] = !image.is_file() && quality > 0 ? encode_jpeg(image, quality) : image;
  }
  copy.gripper = obs.gripper;
  copy.state = obs.state;
  copy.info = obs.info;
  return copy;
}

/// The observation as the JSON of a header; appends its images and states to `blobs`.
inline Json encode_observation(const Observation& obs, std::vector<View>& blobs) {
  Json found = Json::object();
  for (const auto& [name, image] : obs.cameras) {
    const Json reference = image.is_file() ? Json::array({"img", blobs.size()})
                                           : Json::array({"nd", blobs.size(), "|u1", Json::array({image.height, image.width, 3})});
    found["cameras"][name]["$"] = reference;
    blobs.push_back({image.data.data(), image.data.size()});
  }
  for (const auto& [name, values] : obs.state) {
    found["state"][name]["$"] = Json::array({"nd", blobs.size(), "<f4", Json::array({values.size()})});
    blobs.push_back({reinterpret_cast<const std::uint8_t*>(values.data()), values.size() * sizeof(float)});
  }
  if (obs.gripper) {
    if (!std::isfinite(*obs.gripper)) throw Error("invalid_input", "gripper: expected a number from 0 to 1, got NaN or infinity");
    found["gripper"] = *obs.gripper;
  }
  if (!obs.info.is_null() && !obs.info.empty()) found["info"] = obs.info;
  return found;
}

/// Bytes of its images and states.
inline std::size_t size_of(const Observation& obs) {
  std::size_t bytes = 0;
  for (const auto& each : obs.cameras) bytes += each.second.data.size();
  for (const auto& each : obs.state) bytes += each.second.size() * sizeof(float);
  return bytes;
}

/// What begins an episode, kept so that it can begin again.
struct Episode {
  Observation first;
  std::string instruction;
  Json kwargs = Json::object();
  std::deque<Observation> later;  // those that were acted on since, oldest first
};

inline Request reset_request(const Episode& episode, const Json& contract) {
  Request request;
  request.header["op"] = "reset";
  request.header["obs"] = encode_observation(episode.first, request.blobs);
  request.header["instruction"] = episode.instruction;
  if (!episode.kwargs.is_null() && !episode.kwargs.empty()) request.header["kwargs"] = episode.kwargs;
  if (contract.is_object()) request.header["contract"] = contract;
  for (const Observation& each : episode.later)
    request.header["history"].push_back(encode_observation(each, request.blobs));
  return request;
}

inline Request act_request(const Observation& obs) {
  Request request;
  request.header["op"] = "act";
  request.header["obs"] = encode_observation(obs, request.blobs);
  return request;
}

/// The action of a reply, checked: no robot gets NaN, infinity, or rows of another length.
inline Act decode_act(const Frame& reply) {
  const auto found = reply.header.find("act");
  if (found == reply.header.end() || !found->is_object() || !found->contains("action"))
    throw Error("malformed", "expected `act` in the reply to `act`, got none");
  const Json* pointed = reference((*found)["action"]);
  if (pointed == nullptr) throw Error("malformed", "expected a reference as the action, got something else");
  const Array array = array_of(*pointed, reply.blobs);
  if (array.type != "<f4" || array.shape.empty() || array.shape.size() > 2 || array.bytes.empty())
    throw Error("invalid_action", "expected an action of type <f4 and shape [D] or [H, D], got " + pointed->dump());
  Act act;
  act.chunk = array.shape.size() == 2;
  act.rows = act.chunk ? array.shape[0] : 1;
  act.dim = array.shape.back();
  act.values.resize(array.bytes.size() / sizeof(float));
  std::memcpy(act.values.data(), array.bytes.data(), array.bytes.size());
  for (const float value : act.values)
    if (!std::isfinite(value)) throw Error("invalid_action", "expected finite numbers in an action, got NaN or infinity");
  const auto done = found->find("done");
  act.done = done != found->end() && done->is_boolean() && done->get<bool>();
  act.info = resolved(object_at(*found, "info"), reply.blobs);
  act.timing = object_at(reply.header, "timing");
  return act;
}

/// A random UUID, version 4.
inline std::string new_uuid() {
  std::random_device random;
  std::string text;
  for (int i = 0; i < 32; ++i) {
    if (i == 8 || i == 12 || i == 16 || i == 20) text += '-';
    const unsigned digit = random() & 15;
    text += "0123456789abcdef"[i == 12 ? 4 : i == 16 ? (digit & 3) | 8 : digit];
  }
  return text;
}

}  // namespace vlagents_ray::detail

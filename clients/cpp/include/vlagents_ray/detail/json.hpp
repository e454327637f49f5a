// JSON from the network, with a bound on its depth.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>

#include "vlagents_ray/types.hpp"

namespace vlagents_ray::detail {

constexpr int max_depth = 64;

/// Parse UTF-8 JSON, or throw "malformed". nlohmann's parser needs no stack for depth; printing and comparing do.
inline Json parse_json(const char* begin, std::size_t size) {
  const auto bounded = [](int depth, Json::parse_event_t, Json&) {
    if (depth > max_depth) throw Error("malformed", "JSON: expected at most 64 levels, got more");
    return true;
  };
  try {
    return Json::parse(begin, begin + size, bounded);
  } catch (const Json::exception& error) {
    throw Error("malformed", error.what());
  }
}

/// Text of JSON, or throw "invalid_input": of text that is not UTF-8.
inline std::string dump_json(const Json& value) {
  try {
    return value.dump();
  } catch (const Json::exception& error) {
    throw Error("invalid_input", error.what());
  }
}

/// The text at a key of an object, if there is one.
inline std::optional<std::string> text_at(const Json& object, const char* key) {
  if (!object.is_object()) return std::nullopt;
  const auto found = object.find(key);
  if (found == object.end() || !found->is_string()) return std::nullopt;
  return found->get<std::string>();
}

/// The whole number at a key of an object, if there is one from 0 to `most`.
inline std::optional<std::uint64_t> number_at(const Json& object, const char* key, std::uint64_t most) {
  if (!object.is_object()) return std::nullopt;
  const auto found = object.find(key);
  if (found == object.end() || !found->is_number_unsigned() || found->get<std::uint64_t>() > most) return std::nullopt;
  return found->get<std::uint64_t>();
}

/// The object at a key of an object; {} if there is none.
inline Json object_at(const Json& object, const char* key) {
  if (!object.is_object()) return Json::object();
  const auto found = object.find(key);
  return found != object.end() && found->is_object() ? *found : Json::object();
}

/// The error that a reply or a problem+json document states. `code` and `detail` may be missing.
inline Error stated_error(const Json& stated, const std::string& code, const std::string& detail) {
  std::optional<double> retry_after_s;
  if (stated.is_object()) {
    const auto found = stated.find("retry_after_s");
    if (found != stated.end() && found->is_number()) retry_after_s = found->get<double>();
  }
  return Error(text_at(stated, "code").value_or(code), text_at(stated, "detail").value_or(detail), retry_after_s);
}

}  // namespace vlagents_ray::detail

// Frames: a JSON header and the blobs that it refers to (docs/protocol.md, "Frames").
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "vlagents_ray/detail/json.hpp"
#include "vlagents_ray/types.hpp"

#if !defined(__BYTE_ORDER__) || __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "vlagents_ray: arrays are little-endian on the wire; this client does not swap bytes"
#endif

namespace vlagents_ray::detail {

constexpr std::uint8_t protocol_version = 1;
constexpr std::size_t prefix_size = 8;

/// A frame that was received.
struct Frame {
  Json header = Json::object();
  std::vector<Bytes> blobs;
};

/// Bytes of an observation.
struct View {
  const std::uint8_t* data;
  std::size_t size;
};

/// A frame that is to be sent. Its blobs are parts of observations that outlive it.
struct Request {
  Json header = Json::object();
  std::vector<View> blobs;
};

/// An array of the wire.
struct Array {
  std::string type;  // such as "<f4"
  std::vector<std::size_t> shape;
  Bytes bytes;  // the last axis fastest
};

inline std::size_t padding(std::size_t at) { return (8 - at % 8) % 8; }

/// Append the frame to `data`.
inline void encode_frame(const Request& request, Bytes& data) {
  Json header = request.header;
  header["blobs"] = Json::array();
  for (const View& blob : request.blobs) header["blobs"].push_back(blob.size);
  const std::string text = dump_json(header);
  if (text.size() > std::numeric_limits<std::uint32_t>::max()) throw Error("too_large", "the header of a frame");
  const std::size_t begin = data.size();
  data.insert(data.end(), {'V', 'L', 'A', protocol_version});
  const auto length = static_cast<std::uint32_t>(text.size());
  for (int shift = 0; shift < 32; shift += 8) data.push_back(static_cast<std::uint8_t>(length >> shift));
  data.insert(data.end(), text.begin(), text.end());
  for (const View& blob : request.blobs) {
    data.resize(data.size() + padding(data.size() - begin));
    data.insert(data.end(), blob.data, blob.data + blob.size);
  }
}

inline Frame decode_frame(const Bytes& data) {
  const auto rejected = [](const std::string& reason) { return Error("malformed", "frame: " + reason); };
  if (data.size() < prefix_size || std::memcmp(data.data(), "VLA", 3) != 0) throw rejected("expected VLA at its start, got other bytes");
  if (data[3] != protocol_version)
    throw rejected("expected version 1 of the protocol, got " + std::to_string(data[3]) + "; update the client");
  std::uint32_t length = 0;
  for (int byte = 0; byte < 4; ++byte) length |= static_cast<std::uint32_t>(data[4 + byte]) << (8 * byte);
  if (length > data.size() - prefix_size) throw rejected("the header is longer than the frame");
  Frame frame;
  frame.header = parse_json(reinterpret_cast<const char*>(data.data()) + prefix_size, length);
  if (!frame.header.is_object()) throw rejected("expected a JSON object as header, got something else");
  const auto sizes = frame.header.find("blobs");
  if (sizes == frame.header.end() || !sizes->is_array()) throw rejected("expected the list `blobs` in the header, got none");
  std::size_t at = prefix_size + length;
  for (const Json& size : *sizes) {
    const std::size_t gap = padding(at);
    if (!size.is_number_unsigned() || gap > data.size() - at || size.get<std::uint64_t>() > data.size() - at - gap)
      throw rejected("a blob is longer than the frame");
    if (std::any_of(data.begin() + static_cast<std::ptrdiff_t>(at), data.begin() + static_cast<std::ptrdiff_t>(at + gap),
                    [](std::uint8_t byte) { return byte != 0; }))
      throw rejected("expected zeros before a blob, got other bytes");
    const auto begin = data.begin() + static_cast<std::ptrdiff_t>(at + gap);
    const auto end = begin + size.get<std::ptrdiff_t>();
    frame.blobs.emplace_back(begin, end);
    at = static_cast<std::size_t>(end - data.begin());
  }
  if (at != data.size()) throw rejected("expected the end after the last blob, got more bytes");
  return frame;
}

/// Bytes of one value of a type of the wire; 0 if it is none.
inline std::size_t item_size(const std::string& type) {
  static const std::pair<const char*, std::size_t> sizes[] = {
      {"|b1", 1}, {"|i1", 1}, {"<i2", 2}, {"<i4", 4}, {"<i8", 8}, {"|u1", 1},
      {"<u2", 2}, {"<u4", 4}, {"<u8", 8}, {"<f2", 2}, {"<f4", 4}, {"<f8", 8}};
  for (const auto& [name, size] : sizes)
    if (type == name) return size;
  return 0;
}

/// The list behind the `$` of a reference, such as ["nd", 0, "<f4", [50, 7]]; null if the value is none.
inline const Json* reference(const Json& value) {
  if (!value.is_object() || value.size() != 1) return nullptr;
  const auto found = value.find("$");
  if (found == value.end()) return nullptr;
  if (!found->is_array() || found->size() < 2 || !(*found)[0].is_string())
    throw Error("malformed", "frame: invalid reference " + value.dump());
  return &*found;
}

inline const Bytes& blob_of(const Json& reference, const std::vector<Bytes>& blobs) {
  if (!reference[1].is_number_unsigned() || reference[1].get<std::uint64_t>() >= blobs.size())
    throw Error("malformed", "frame: the blob of this reference does not exist: " + reference.dump());
  return blobs[reference[1].get<std::size_t>()];
}

inline Array array_of(const Json& reference, const std::vector<Bytes>& blobs) {
  const auto rejected = [&] { return Error("malformed", "frame: invalid array " + reference.dump()); };
  if (reference.size() != 4 || reference[0] != "nd" || !reference[2].is_string() || !reference[3].is_array()) throw rejected();
  Array found{reference[2].get<std::string>(), {}, blob_of(reference, blobs)};
  std::size_t bytes = item_size(found.type);
  if (bytes == 0 || reference[3].size() > 32) throw rejected();
  for (const Json& axis : reference[3]) {
    if (!axis.is_number_unsigned() || axis.get<std::uint64_t>() > std::numeric_limits<std::uint32_t>::max()) throw rejected();
    found.shape.push_back(axis.get<std::size_t>());
    if (found.shape.back() != 0 && bytes > std::numeric_limits<std::size_t>::max() / found.shape.back()) throw rejected();
    bytes *= found.shape.back();
  }
  if (bytes != found.bytes.size()) throw rejected();
  return found;
}

namespace parts {

struct Half {  // IEEE 754's binary16, which C++17 has no type for
  std::uint16_t bits;
};

struct Truth {
  std::uint8_t byte;
};

template <typename Number>
Json value_of(Number number) {
  return number;
}

inline Json value_of(Truth truth) { return truth.byte != 0; }

inline Json value_of(Half half) {
  const int exponent = half.bits >> 10 & 31;
  const int fraction = half.bits & 1023;
  double size = 0;
  if (exponent == 31 && fraction != 0) size = std::numeric_limits<double>::quiet_NaN();
  else if (exponent == 31) size = std::numeric_limits<double>::infinity();
  else if (exponent == 0) size = std::ldexp(fraction, -24);
  else size = std::ldexp(1024 + fraction, exponent - 25);
  return half.bits >> 15 != 0 ? -size : size;
}

/// Values and bytes that the references of one message may still take. A value of `Json` takes 16 bytes and more, a list of
/// one value over 100, so a small array of many axes, named again and again, could fill the memory of a robot's computer.
struct Room {
  std::size_t values = 1'000'000;
  std::size_t bytes = 128 * 1024 * 1024;

  static void take(std::size_t& left, std::size_t size) {
    if (size > left) throw Error("too_large", "frame: expected at most 1,000,000 values and 128 MiB behind its references, got more");
    left -= size;
  }
};

template <typename Number>
Json numbers(const Array& array, std::size_t axis, std::size_t& at, Room& room) {
  if (axis == array.shape.size()) {
    Number found;
    std::memcpy(&found, array.bytes.data() + at, sizeof found);
    at += sizeof found;
    return value_of(found);
  }
  Room::take(room.values, array.shape[axis]);
  Json list = Json::array();
  for (std::size_t number = 0; number < array.shape[axis]; ++number)
    list.push_back(numbers<Number>(array, axis + 1, at, room));
  return list;
}

inline Json numbers_of(const Array& array, Room& room) {
  if (array.bytes.empty()) return Json::array();  // also of a shape such as [4000000000, 0]
  std::size_t at = 0;
  if (array.type == "|b1") return numbers<Truth>(array, 0, at, room);
  if (array.type == "|i1") return numbers<std::int8_t>(array, 0, at, room);
  if (array.type == "<i2") return numbers<std::int16_t>(array, 0, at, room);
  if (array.type == "<i4") return numbers<std::int32_t>(array, 0, at, room);
  if (array.type == "<i8") return numbers<std::int64_t>(array, 0, at, room);
  if (array.type == "|u1") return numbers<std::uint8_t>(array, 0, at, room);
  if (array.type == "<u2") return numbers<std::uint16_t>(array, 0, at, room);
  if (array.type == "<u4") return numbers<std::uint32_t>(array, 0, at, room);
  if (array.type == "<u8") return numbers<std::uint64_t>(array, 0, at, room);
  if (array.type == "<f2") return numbers<Half>(array, 0, at, room);
  if (array.type == "<f4") return numbers<float>(array, 0, at, room);
  return numbers<double>(array, 0, at, room);
}

}  // namespace parts

/// A value of a header in which each reference is replaced by what it stands for: arrays of numbers by lists of lists,
/// files and bytes by nlohmann's binary values, and numbers that JSON lacks by floating-point ones.
inline Json resolved(const Json& value, const std::vector<Bytes>& blobs, parts::Room& room) {
  if (const Json* found = reference(value)) {
    const std::string kind = (*found)[0].get<std::string>();
    if (kind == "nd") return parts::numbers_of(array_of(*found, blobs), room);
    if (kind == "img" || kind == "bin") {
      const Bytes& blob = blob_of(*found, blobs);
      parts::Room::take(room.bytes, blob.size());
      return Json::binary(blob);
    }
    if (kind == "float" && (*found)[1] == "nan") return std::numeric_limits<double>::quiet_NaN();
    if (kind == "float" && (*found)[1] == "inf") return std::numeric_limits<double>::infinity();
    if (kind == "float" && (*found)[1] == "-inf") return -std::numeric_limits<double>::infinity();
    throw Error("malformed", "frame: invalid reference " + value.dump());
  }
  if (!value.is_object() && !value.is_array()) return value;
  Json copy = value;
  for (Json& each : copy) each = resolved(Json(each), blobs, room);
  return copy;
}

inline Json resolved(const Json& value, const std::vector<Bytes>& blobs) {
  parts::Room room;
  return resolved(value, blobs, room);
}

}  // namespace vlagents_ray::detail

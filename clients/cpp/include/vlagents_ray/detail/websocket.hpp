// The client's side of RFC 6455, without extensions.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <mutex>
#include <random>
#include <string>
#include <utility>

#include "vlagents_ray/detail/http.hpp"
#include "vlagents_ray/detail/socket.hpp"

namespace vlagents_ray::detail {

constexpr std::size_t max_message = 16 * 1024 * 1024;  // bytes, in either direction

inline std::array<std::uint8_t, 20> sha1(const std::string& text) {
  const auto rotated = [](std::uint32_t value, int by) { return value << by | value >> (32 - by); };
  std::array<std::uint32_t, 5> state{0x67452301, 0xefcdab89, 0x98badcfe, 0x10325476, 0xc3d2e1f0};
  std::string data = text + '\x80';
  data.resize((data.size() + 8 + 63) / 64 * 64);
  const std::uint64_t bits = std::uint64_t{text.size()} * 8;
  for (int byte = 0; byte < 8; ++byte) data[data.size() - 1 - byte] = static_cast<char>(bits >> (8 * byte));
  for (std::size_t block = 0; block < data.size(); block += 64) {
    std::array<std::uint32_t, 80> words{};
    for (std::size_t i = 0; i < 64; ++i)
      words[i / 4] = words[i / 4] << 8 | static_cast<std::uint8_t>(data[block + i]);
    for (std::size_t i = 16; i < 80; ++i)
      words[i] = rotated(words[i - 3] ^ words[i - 8] ^ words[i - 14] ^ words[i - 16], 1);
    auto [a, b, c, d, e] = state;
    for (std::size_t i = 0; i < 80; ++i) {
      const std::uint32_t mixed = i < 20   ? ((b & c) | (~b & d)) + 0x5a827999
                                  : i < 40 ? (b ^ c ^ d) + 0x6ed9eba1
                                  : i < 60 ? ((b & c) | (b & d) | (c & d)) + 0x8f1bbcdc
                                           : (b ^ c ^ d) + 0xca62c1d6;
      const std::uint32_t next = rotated(a, 5) + mixed + e + words[i];
      e = d;
      d = c;
      c = rotated(b, 30);
      b = a;
      a = next;
    }
    const std::array<std::uint32_t, 5> sum{a, b, c, d, e};
    for (std::size_t i = 0; i < 5; ++i) state[i] += sum[i];
  }
  std::array<std::uint8_t, 20> digest{};
  for (std::size_t i = 0; i < 20; ++i) digest[i] = static_cast<std::uint8_t>(state[i / 4] >> (24 - 8 * (i % 4)));
  return digest;
}

template <typename Data>
std::string base64(const Data& data) {
  static const char letters[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  for (std::size_t i = 0; i < data.size(); i += 3) {
    std::uint32_t bits = 0;
    for (std::size_t j = 0; j < 3; ++j) bits = bits << 8 | (i + j < data.size() ? data[i + j] : 0);
    for (std::size_t j = 0; j < 4; ++j) text += i + j <= data.size() ? letters[bits >> (18 - 6 * j) & 63] : '=';
  }
  return text;
}

/// A WebSocket. One thread may receive while others send.
class WebSocket {
 public:
  WebSocket(const Url& url, const std::string& path, Headers headers, const Deadline& deadline)
      : socket_(Socket::connect(url.host, url.port, deadline)), reader_(socket_) {
    std::array<std::uint8_t, 16> nonce{};
    for (auto& byte : nonce) byte = static_cast<std::uint8_t>(random_());
    const std::string key = base64(nonce);
    headers["upgrade"] = "websocket";
    headers["connection"] = "Upgrade";
    headers["sec-websocket-version"] = "13";
    headers["sec-websocket-key"] = key;
    send_text(socket_, request_text(url, path, headers), deadline);
    Response response = read_head(reader_, deadline);
    if (response.status != 101) {
      read_body(reader_, response, deadline);
      throw response.error();
    }
    if (lower(response.headers["upgrade"]) != "websocket" ||
        response.headers["sec-websocket-accept"] != base64(sha1(key + "258EAFA5-E914-47DA-95CA-C5AB0DC85B11")) ||
        response.headers.count("sec-websocket-extensions") != 0)
      throw Error("malformed", "the answer to the handshake does not belong to this WebSocket; does a proxy in between answer?");
  }

  /// Send one binary message, in one frame.
  /// @param append appends the message to the bytes that it is given
  template <typename Append>
  void send(Append&& append, const Deadline& deadline) {
    send_frame(binary, append, deadline);
  }

  /// The next binary message. Pings are answered meanwhile. A close of the server's is "connection_lost", with its code.
  Bytes receive(const Deadline& deadline) {
    Bytes message;
    bool begun = false;
    while (true) {
      const std::uint8_t first = reader_.byte(deadline);
      const std::uint8_t second = reader_.byte(deadline);
      const int kind = first & 15;
      const bool last = (first & 128) != 0;
      std::uint64_t size = second & 127;
      if ((first & 112) != 0 || (second & 128) != 0) throw rejected("a compressed or masked frame");
      if (kind >= 8 && (!last || size > 125)) throw rejected("a control frame that is too long, or in fragments");
      if (size >= 126) {
        const int bytes = size == 126 ? 2 : 8;
        size = 0;
        for (int i = 0; i < bytes; ++i) size = size << 8 | reader_.byte(deadline);
      }
      if (size > max_message - message.size()) throw Error("too_large", "WebSocket: expected messages of at most 16 MiB, got a larger one");
      if (kind == close_ || kind == ping || kind == pong) {
        Bytes control;
        reader_.read(control, static_cast<std::size_t>(size), deadline);
        if (kind == close_) throw closed(control);
        if (kind == ping) send_control(pong, control, Deadline::in(pong_s));
        continue;
      }
      if (kind != (begun ? continuation : binary))
        throw rejected(kind == 1 ? "a text message" : "an unknown frame, or fragments out of order");
      reader_.read(message, static_cast<std::size_t>(size), deadline);
      begun = !last;
      if (last) return message;
    }
  }

  /// Tell the server that nothing more comes, as far as that goes at once.
  void say_close() noexcept {
    try {
      send_control(close_, {1000 >> 8, 1000 & 255}, Deadline::in(0.1));
    } catch (const std::exception&) {  // the connection ends in any case
    }
  }

  /// Wake whoever sends or receives, with "connection_lost".
  void shut() const noexcept { socket_.shut(); }

 private:
  enum Kind { continuation = 0, binary = 2, close_ = 8, ping = 9, pong = 10 };
  static constexpr double pong_s = 5.0;
  static constexpr std::size_t most_head = 2 + 8 + 4;  // bytes before the message: kind, length and mask

  static Error rejected(const std::string& what) { return Error("malformed", "WebSocket: unexpected: " + what); }

  Error closed(const Bytes& payload) {
    send_reply_to_close(payload);
    if (payload.size() < 2) return Error("connection_lost", "the server closed the connection");
    const int code = payload[0] << 8 | payload[1];
    return Error("connection_lost", "the server closed the connection with code " + std::to_string(code) + " " +
                                        std::string(payload.begin() + 2, payload.end()));
  }

  void send_reply_to_close(const Bytes& payload) noexcept {
    try {
      send_control(close_, Bytes(payload.begin(), payload.begin() + (payload.size() < 2 ? 0 : 2)), Deadline::in(0.1));
    } catch (const std::exception&) {  // the connection has ended in any case
    }
  }

  void send_control(Kind kind, const Bytes& payload, const Deadline& deadline) {
    send_frame(kind, [&](Bytes& data) { data.insert(data.end(), payload.begin(), payload.end()); }, deadline);
  }

  template <typename Append>
  void send_frame(Kind kind, Append&& append, const Deadline& deadline) {
    const std::lock_guard<std::mutex> guard(sending_);
    if (broken_) throw Error("connection_lost", "an earlier message was sent in part");
    frame_.assign(most_head, 0);
    append(frame_);
    const std::size_t size = frame_.size() - most_head;
    if (size > max_message)
      throw Error("too_large",
                  "expected a message of at most 16 MiB, got " + std::to_string(size) + " bytes; send JPEG or smaller images");
    const std::size_t bytes = size < 126 ? 0 : size < 65536 ? 2 : 8;
    std::uint8_t* const payload = frame_.data() + most_head;
    std::uint8_t* const mask = payload - 4;
    std::uint8_t* const head = mask - bytes - 2;
    head[0] = static_cast<std::uint8_t>(128 | kind);
    head[1] = static_cast<std::uint8_t>(128 | (bytes == 0 ? size : bytes == 2 ? 126 : 127));
    for (std::size_t i = 0; i < bytes; ++i) head[1 + bytes - i] = static_cast<std::uint8_t>(size >> (8 * i));
    const std::uint32_t chosen = random_();
    std::memcpy(mask, &chosen, 4);
    const std::uint64_t wide = std::uint64_t{chosen} << 32 | chosen;  // pixels are masked eight bytes at a time
    std::size_t at = 0;
    for (; at + 8 <= size; at += 8) {
      std::uint64_t word = 0;
      std::memcpy(&word, payload + at, 8);
      word ^= wide;
      std::memcpy(payload + at, &word, 8);
    }
    for (; at < size; ++at) payload[at] = static_cast<std::uint8_t>(payload[at] ^ mask[at % 4]);
    try {
      socket_.send(head, frame_.size() - static_cast<std::size_t>(head - frame_.data()), deadline);
    } catch (const Error&) {
      broken_ = true;  // what follows would be read as the rest of this message
      socket_.shut();
      throw;
    }
  }

  Socket socket_;
  Reader reader_;
  std::mutex sending_;
  Bytes frame_;                // what is sent, in memory that is used again
  std::random_device random_;  // masks must not be predictable
  bool broken_ = false;
};

}  // namespace vlagents_ray::detail

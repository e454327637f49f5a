// As much of HTTP/1.1 as the metadata and the handshake of a WebSocket need.
#pragma once

#include <algorithm>
#include <cctype>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <map>
#include <string>
#include <utility>

#include "vlagents_ray/detail/json.hpp"
#include "vlagents_ray/detail/socket.hpp"

namespace vlagents_ray::detail {

constexpr std::size_t max_head = 64 * 1024;          // bytes of a response's head
constexpr std::size_t max_body = 16 * 1024 * 1024;  // bytes of its body

using Headers = std::map<std::string, std::string>;  // names in lower case

inline std::string lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(), [](unsigned char letter) { return std::tolower(letter); });
  return text;
}

inline std::string trimmed(const std::string& text) {
  const auto begin = text.find_first_not_of(" \t");
  return begin == std::string::npos ? "" : text.substr(begin, text.find_last_not_of(" \t") - begin + 1);
}

/// Where a server is, from "http://host:port/prefix" or "ws://…".
struct Url {
  std::string host;    // without the brackets of an IPv6 address
  std::string port;
  std::string prefix;  // "" or "/app"

  static Url parse(const std::string& text) {
    const auto colon = text.find("://");
    const std::string scheme = lower(text.substr(0, colon == std::string::npos ? 0 : colon));
    if (scheme == "https" || scheme == "wss")
      throw Error("invalid_input", text + ": this client does no TLS; let a tunnel (ssh -L, stunnel) or a proxy on this "
                                          "machine encrypt, and give its http:// address");
    if (scheme != "http" && scheme != "ws") throw Error("invalid_input", "url: expected http://host:port or ws://host:port, got " + text);
    const std::string rest = text.substr(colon + 3);
    const auto slash = rest.find('/');
    const std::string place = rest.substr(0, slash);
    Url url;
    url.prefix = slash == std::string::npos ? "" : rest.substr(slash);
    while (!url.prefix.empty() && url.prefix.back() == '/') url.prefix.pop_back();
    const auto bracket = place.find(']');
    const auto port = place.find(':', place.rfind('[', 0) == 0 && bracket != std::string::npos ? bracket : 0);
    url.host = place.substr(0, port);
    url.port = port == std::string::npos ? "80" : place.substr(port + 1);
    if (url.host.size() > 2 && url.host.front() == '[' && url.host.back() == ']')
      url.host = url.host.substr(1, url.host.size() - 2);
    const bool digits = !url.port.empty() && url.port.find_first_not_of("0123456789") == std::string::npos;
    const bool visible = std::all_of(text.begin(), text.end(), [](char letter) { return letter > ' ' && letter < 127; });
    if (url.host.empty() || url.port.size() > 5 || !digits || !visible)
      throw Error("invalid_input", "url: expected http://host:port, got " + text);
    return url;
  }

  /// The header `host`.
  std::string authority() const { return (host.find(':') == std::string::npos ? host : "[" + host + "]") + ":" + port; }
};

/// A socket that is read by the line or by the number of bytes.
class Reader {
 public:
  explicit Reader(const Socket& socket) : socket_(socket) {}

  /// One byte or more arrived that were not read yet.
  bool buffered() const noexcept { return at_ < end_; }

  std::string line(std::size_t most, const Deadline& deadline) {
    std::string found;
    while (true) {
      const char letter = static_cast<char>(byte(deadline));
      if (letter == '\n') break;
      if (found.size() >= most) throw Error("malformed", "HTTP: the head of the answer is longer than this client reads");
      found.push_back(letter);
    }
    if (!found.empty() && found.back() == '\r') found.pop_back();
    return found;
  }

  std::uint8_t byte(const Deadline& deadline) {
    if (!buffered() && !fill(deadline)) throw Error("connection_lost", "the server closed the connection");
    return buffer_[at_++];
  }

  /// Append `size` bytes to `data`. Memory grows with what arrives, not with what was announced.
  void read(Bytes& data, std::size_t size, const Deadline& deadline) {
    while (size > 0) {
      if (!buffered() && !fill(deadline)) throw Error("connection_lost", "the server closed the connection in a message");
      const std::size_t some = std::min(size, end_ - at_);
      data.insert(data.end(), buffer_ + at_, buffer_ + at_ + some);
      at_ += some;
      size -= some;
    }
  }

  /// Append what comes until the server closes the connection.
  void read_all(Bytes& data, std::size_t most, const Deadline& deadline) {
    while (buffered() || fill(deadline)) {
      data.insert(data.end(), buffer_ + at_, buffer_ + end_);
      at_ = end_;
      if (data.size() > most) throw Error("too_large", "HTTP: the answer is longer than this client reads");
    }
  }

 private:
  bool fill(const Deadline& deadline) {
    at_ = 0;
    end_ = socket_.receive(buffer_, sizeof buffer_, deadline);
    return end_ > 0;
  }

  const Socket& socket_;
  std::uint8_t buffer_[65536];
  std::size_t at_ = 0;
  std::size_t end_ = 0;
};

struct Response {
  int status = 0;
  Headers headers;
  Bytes body;

  /// Return the exception for the answer of a rejected request.
  Error error() const {
    const std::string code = status == 401   ? "unauthorized"
                             : status == 403 ? "forbidden"
                             : status == 404 ? "unavailable"  // the proxy does not know the application yet
                             : status == 429 ? "too_many_requests"
                             : status == 503 ? "unavailable"
                                             : "internal";
    const std::string plain = "HTTP " + std::to_string(status);
    Json stated = Json::object();
    const auto type = headers.find("content-type");
    if (type != headers.end() && type->second.find("json") != std::string::npos && !body.empty()) {
      try {
        stated = parse_json(reinterpret_cast<const char*>(body.data()), body.size());
      } catch (const Error&) {  // an answer of something in between: the status says enough
      }
    }
    const auto retry = headers.find("retry-after");
    if (retry != headers.end() && stated.is_object() && !stated.contains("retry_after_s")) {
      char* end = nullptr;
      const double seconds = std::strtod(retry->second.c_str(), &end);
      if (end != retry->second.c_str() && seconds >= 0) stated["retry_after_s"] = seconds;
    }
    return stated_error(stated, code, plain);
  }
};

inline Headers read_headers(Reader& reader, const Deadline& deadline) {
  Headers headers;
  std::size_t left = max_head;
  for (std::string line = reader.line(left, deadline); !line.empty(); line = reader.line(left, deadline)) {
    left -= std::min(left, line.size() + 1);
    const auto colon = line.find(':');
    if (colon == std::string::npos) throw Error("malformed", "HTTP: expected a colon in each header, got a header without one");
    headers[lower(line.substr(0, colon))] = trimmed(line.substr(colon + 1));
  }
  return headers;
}

inline Response read_head(Reader& reader, const Deadline& deadline) {
  const std::string line = reader.line(max_head, deadline);
  Response response;
  if (line.size() < 12 || line.compare(0, 7, "HTTP/1.") != 0 || line[8] != ' ')
    throw Error("malformed", "the server does not speak HTTP/1.1: is this the right port?");
  response.status = std::atoi(line.substr(9, 3).c_str());
  response.headers = read_headers(reader, deadline);
  return response;
}

inline void read_body(Reader& reader, Response& response, const Deadline& deadline) {
  const auto check_size = [](std::size_t size) {
    if (size > max_body) throw Error("too_large", "HTTP: the answer is longer than this client reads");
  };
  const auto number = [](const std::string& text, int base) {
    char* end = nullptr;
    const unsigned long found = std::strtoul(text.c_str(), &end, base);
    if (text.empty() || !std::isxdigit(static_cast<unsigned char>(text[0])) || (*end != '\0' && *end != ';'))
      throw Error("malformed", "HTTP: expected a number as the length, got something else");
    return static_cast<std::size_t>(found);
  };
  const auto coding = response.headers.find("transfer-encoding");
  const auto length = response.headers.find("content-length");
  if (coding != response.headers.end() && lower(coding->second) == "chunked") {
    while (const std::size_t size = number(reader.line(max_head, deadline), 16)) {
      check_size(size);
      check_size(response.body.size() + size);
      reader.read(response.body, size, deadline);
      reader.line(2, deadline);
    }
    read_headers(reader, deadline);
  } else if (length != response.headers.end()) {
    const std::size_t size = number(length->second, 10);
    check_size(size);
    reader.read(response.body, size, deadline);
  } else {
    reader.read_all(response.body, max_body, deadline);
  }
}

/// The text of a request without a body. `more` are headers, such as the API key.
inline std::string request_text(const Url& url, const std::string& path, const Headers& more) {
  std::string text = "GET " + path + " HTTP/1.1\r\nHost: " + url.authority() + "\r\n";
  for (const auto& [name, value] : more) {
    if (value.find_first_of("\r\n") != std::string::npos) throw Error("invalid_input", name + ": expected no line break, got one");
    text += name + ": " + value + "\r\n";
  }
  return text + "\r\n";
}

inline void send_text(const Socket& socket, const std::string& text, const Deadline& deadline) {
  socket.send(reinterpret_cast<const std::uint8_t*>(text.data()), text.size(), deadline);
}

/// GET a JSON document, or throw the error with which the server rejected it.
inline Json get_json(const Url& url, const std::string& path, Headers headers, const Deadline& deadline) {
  headers["accept"] = "application/json";
  headers["connection"] = "close";
  const Socket socket = Socket::connect(url.host, url.port, deadline);
  send_text(socket, request_text(url, url.prefix + path, headers), deadline);
  Reader reader(socket);
  Response response = read_head(reader, deadline);
  read_body(reader, response, deadline);
  if (response.status != 200) throw response.error();
  return parse_json(reinterpret_cast<const char*>(response.body.data()), response.body.size());
}

}  // namespace vlagents_ray::detail

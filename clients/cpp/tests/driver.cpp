// What tests/clients/test_cpp.py drives: each line of stdin is a JSON object that says what to `do`, each line of stdout
// what came of it, {"error": {"code", "detail", "retry_after_s"}} included.
#include <chrono>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "vlagents_ray/vlagents_ray.hpp"

namespace {

using namespace vlagents_ray;

Bytes from_hex(const std::string& text) {
  Bytes bytes;
  for (std::size_t i = 0; i + 1 < text.size(); i += 2)
    bytes.push_back(static_cast<std::uint8_t>(std::stoi(text.substr(i, 2), nullptr, 16)));
  return bytes;
}

std::string to_hex(const Bytes& bytes) {
  std::string text;
  for (const std::uint8_t byte : bytes) {
    text += "0123456789abcdef"[byte >> 4];
    text += "0123456789abcdef"[byte & 15];
  }
  return text;
}

// {"cameras": {"front": {"rgb": VALUE or "pixels": HEX, "height", "width"} or {"file": HEX}}, "state", "gripper", "info"}
Observation observation(const Json& asked) {
  Observation obs;
  const Json cameras = asked.value("cameras", Json::object());
  const Json state = asked.value("state", Json::object());
  for (const auto& [name, image] : cameras.items()) {
    if (image.contains("file")) {
      obs.cameras[name] = Image::file(from_hex(image["file"]));
      continue;
    }
    const std::size_t height = image["height"], width = image["width"];
    obs.cameras[name] = image.contains("pixels")
                            ? Image::rgb(from_hex(image["pixels"]), height, width)
                            : Image::rgb(Bytes(height * width * 3, image["rgb"].get<std::uint8_t>()), height, width);
  }
  for (const auto& [name, values] : state.items()) obs.state[name] = values.get<std::vector<float>>();
  if (asked.contains("gripper")) obs.gripper = asked["gripper"].get<double>();
  obs.info = asked.value("info", Json::object());
  return obs;
}

Json shown(const Act& act) {
  return {{"values", act.values}, {"rows", act.rows},       {"dim", act.dim},   {"chunk", act.chunk},
          {"done", act.done},     {"resumed", act.resumed}, {"info", act.info}, {"timing", act.timing}};
}

Json shown(const Command& command) {
  return {{"action", command.action}, {"row", command.row}, {"done", command.done}};
}

class Driver {
 public:
  Json operator()(const Json& asked) {
    const std::string what = asked["do"];
    if (what == "decode") return decode(from_hex(asked["data"]));
    if (what == "reply") return reply(from_hex(asked["data"]));
    if (what == "request") return request(asked);
    if (what == "jpeg") return to_hex(detail::prepared(observation(asked["obs"]), asked["quality"]).cameras.at("front").data);
    if (what == "connect") return connect(asked);
    if (what == "metadata") return client_->metadata();
    if (what == "reset") {
      const Observation obs = observation(asked.value("obs", Json::object()));
      const std::string instruction = asked.value("instruction", "");
      const Json kwargs = asked.value("kwargs", Json::object());
      return player_ ? player_->reset(obs, instruction, kwargs) : client_->reset(obs, instruction, kwargs);
    }
    if (what == "act") return act(observation(asked.value("obs", Json::object())), asked.value("wait", true));
    if (what == "missed") {
      player_->count_missed(asked["ticks"].get<std::size_t>());
      return {};
    }
    if (what == "ticks") {
      const Ticks ticks = player_->ticks();
      return {{"ticks", ticks.all}, {"starved", ticks.starved}, {"share", ticks.share() ? Json(*ticks.share()) : Json()}};
    }
    if (what == "close") {
      client_->close();
      return {};
    }
    if (what == "round_trips") return round_trips(observation(asked["obs"]), asked["count"]);
    throw Error("invalid_input", "do: got " + what);
  }

 private:
  Json connect(const Json& asked) {
    Options options;
    options.url = asked["url"];
    options.api_key = asked.value("key", "");
    options.timeout_s = asked.value("timeout_s", 20.0);
    options.jpeg_quality = asked.value("jpeg_quality", 90);
    options.resume = asked.value("resume", true);
    options.history = asked.value("history", 16);
    options.session = asked.value("session", "");
    options.contract = asked.value("contract", Json());
    player_.reset();
    client_ = std::make_unique<Client>(options);
    if (asked.contains("ahead"))
      player_ = std::make_unique<ChunkPlayer>(*client_, asked["ahead"].get<std::size_t>(), asked.value("execute", 0));
    return {};
  }

  Json act(const Observation& obs, bool wait) {
    if (!player_) return shown(client_->act(obs));
    if (wait) return shown(player_->act(obs));
    const auto command = player_->try_act(obs);
    return command ? shown(*command) : Json();
  }

  Json round_trips(const Observation& obs, int count) {
    Json milliseconds = Json::array();
    for (int i = 0; i < count; ++i) {
      const auto begin = std::chrono::steady_clock::now();
      client_->act(obs);
      milliseconds.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begin).count());
    }
    return milliseconds;
  }

  // A frame: its header, its blobs, whether the same comes of encoding it again, and the values behind its references.
  static Json decode(const Bytes& data) {
    const detail::Frame frame = detail::decode_frame(data);
    Json blobs = Json::array();
    for (const Bytes& blob : frame.blobs) blobs.push_back(to_hex(blob));
    const detail::Frame again = detail::decode_frame(encoded({frame.header, views(frame.blobs)}));
    return {{"header", frame.header},
            {"blobs", blobs},
            {"same", again.header == frame.header && again.blobs == frame.blobs},
            {"values", detail::resolved(frame.header, frame.blobs)}};
  }

  static Bytes encoded(const detail::Request& request) {
    Bytes data;
    detail::encode_frame(request, data);
    return data;
  }

  static std::vector<detail::View> views(const std::vector<Bytes>& blobs) {
    std::vector<detail::View> found;
    for (const Bytes& blob : blobs) found.push_back({blob.data(), blob.size()});
    return found;
  }

  // What `reset` and `act` send, but for what names the session and the request.
  static Json request(const Json& asked) {
    if (asked["op"] == "act") {
      const Observation obs = observation(asked["obs"]);
      return to_hex(encoded(detail::act_request(obs)));
    }
    detail::Episode episode{observation(asked["obs"]), asked["instruction"], asked.value("kwargs", Json::object()), {}};
    for (const Json& each : asked.value("history", Json::array())) episode.later.push_back(observation(each));
    return to_hex(encoded(detail::reset_request(episode, asked.value("contract", Json()))));
  }

  // A reply as `act`, `reset` and `close` read it.
  static Json reply(const Bytes& data) {
    const detail::Frame frame = detail::decode_frame(data);
    const auto error = frame.header.find("error");
    if (error != frame.header.end()) throw detail::stated_error(*error, "internal", "");
    if (!frame.header.contains("info")) return shown(detail::decode_act(frame));
    return {{"info", detail::resolved(detail::object_at(frame.header, "info"), frame.blobs)}};
  }

  std::unique_ptr<Client> client_;
  std::unique_ptr<ChunkPlayer> player_;  // after the client, which it uses
};

}  // namespace

int main() {
  Driver driver;
  for (std::string line; std::getline(std::cin, line);) {
    Json answer;
    try {
      answer = {{"result", driver(Json::parse(line))}};
    } catch (const Error& error) {
      answer["error"] = {{"code", error.code()}, {"detail", error.detail()}};
      if (error.retry_after_s()) answer["error"]["retry_after_s"] = *error.retry_after_s();
    }
    std::cout << answer.dump(-1, ' ', false, Json::error_handler_t::replace) << std::endl;
  }
}

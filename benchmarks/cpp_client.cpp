// The C++ client of a benchmark: cpp_client URL FOLDER
// It obeys the line protocol of benchmarks/line_client.py: a number of calls in, the milliseconds of each out.
#include <chrono>
#include <cstddef>
#include <fstream>
#include <iostream>
#include <iterator>
#include <string>
#include <vector>

#include "vlagents_ray/vlagents_ray.hpp"

namespace {

using namespace vlagents_ray;

Observation read(const std::string& folder) {
  std::ifstream file(folder + "/obs.json");
  const Json stated = Json::parse(file);
  Observation obs;
  for (const auto& [name, size] : stated["cameras"].items()) {
    std::ifstream pixels(folder + "/" + name, std::ios::binary);
    obs.cameras[name] = Image::rgb(Bytes(std::istreambuf_iterator<char>(pixels), {}), size[0], size[1]);
  }
  for (const auto& [name, values] : stated["state"].items()) obs.state[name] = values.get<std::vector<float>>();
  obs.gripper = stated["gripper"].get<double>();
  return obs;
}

Json measure(Client& client, const Observation& obs, int calls) {
  Json taken = Json::array();
  for (int call = 0; call < calls; ++call) {
    const auto begun = std::chrono::steady_clock::now();
    client.act(obs);
    taken.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - begun).count());
  }
  return taken;
}

}  // namespace

int main(int, char** argv) {
  Options options;
  options.url = argv[1];
  options.jpeg_quality = 0;
  Client client(options);
  const Observation obs = read(argv[2]);
  client.reset(obs, "a task");
  measure(client, obs, 20);
  std::cout << R"({"transport": "websocket"})" << std::endl;
  for (std::string line; std::getline(std::cin, line);) std::cout << measure(client, obs, std::stoi(line)) << std::endl;
}

// A robot's loop: observe, act, 20 times a second. `vlagents_ray_loop http://gpu-box:8000 [SECONDS]`
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <string>
#include <thread>
#include <vector>

#include "vlagents_ray/vlagents_ray.hpp"

namespace {

// In place of these two, read your cameras and encoders, and command your motors.
vlagents_ray::Observation observe() {
  vlagents_ray::Observation obs;
  obs.cameras["front"] = vlagents_ray::Image::rgb(vlagents_ray::Bytes(224 * 224 * 3, 127), 224, 224);
  obs.state["joints"] = std::vector<float>(7, 0.0F);
  obs.gripper = 1.0;
  return obs;
}

void apply(const std::vector<float>& action) { std::printf("%.3f of %zu numbers\n", action.front(), action.size()); }

}  // namespace

int main(int argc, char** argv) try {
  vlagents_ray::Options options;
  options.url = argc > 1 ? argv[1] : "http://127.0.0.1:8000";
  options.timeout_s = 3.0;
  if (const char* key = std::getenv("VLAGENTS_RAY_API_KEY")) options.api_key = key;
  const double seconds = argc > 2 ? std::stod(argv[2]) : 10.0;

  vlagents_ray::Client client(options);
  vlagents_ray::ChunkPlayer player(client, 3);  // the next chunk is asked for when three rows are left
  player.reset(observe(), "push the cube to the goal");

  constexpr auto period = std::chrono::milliseconds(50);
  auto tick = std::chrono::steady_clock::now();
  const auto end = tick + std::chrono::duration<double>(seconds);
  while (tick < end) {
    if (const auto command = player.try_act(observe())) {
      apply(command->action);
      if (command->done) break;
    }  // else no action is there in time: a robot that takes absolute targets stays where it is
    tick += period;
    std::this_thread::sleep_until(tick);
  }
  const vlagents_ray::Ticks ticks = player.ticks();
  std::printf("in time: %.2f%% of %zu ticks\n", 100 * ticks.share().value_or(1), ticks.all);
  return 0;
} catch (const vlagents_ray::Error& error) {
  std::fprintf(stderr, "%s\n", error.what());
  return 1;
}

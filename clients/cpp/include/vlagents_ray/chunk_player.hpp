// One action at each tick, of a policy that answers with chunks.
#pragma once

#include <chrono>
#include <condition_variable>
#include <cstddef>
#include <exception>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "vlagents_ray/client.hpp"

namespace vlagents_ray {

/// What the robot executes in one tick.
struct Command {
  std::vector<float> action;  // D numbers
  std::size_t row = 0;        // of its chunk, from 0
  bool done = false;          // the policy considers the task finished; with the last row of a chunk
};

/// The ticks of an episode at which the policy was to act, and those of them that are starved: no answer had a row.
struct Ticks {
  std::size_t all = 0;
  std::size_t starved = 0;

  /// The share of the ticks in time, from 0 to 1; none without ticks.
  std::optional<double> share() const {
    if (all == 0) return std::nullopt;
    return 1.0 - static_cast<double>(starved) / static_cast<double>(all);
  }
};

/// Plays chunks open loop. A thread asks for the next one while the last rows of this one are executed.
///
/// The next chunk belongs to the observation of the tick at which it was asked for: its first rows, in place of which
/// rows of this chunk were executed meanwhile, are left out. No row is left out for the time that the robot held still.
/// Each request reports the ticks since the last one, and the age of the last action, to the server.
class ChunkPlayer {
 public:
  /// @param client outlives the player, which alone uses it meanwhile
  /// @param ahead rows left of a chunk when the next one is asked for. 0 asks when none is left, and the robot waits
  /// @param execute rows of a chunk that are executed at most; 0 executes all
  explicit ChunkPlayer(Client& client, std::size_t ahead = 0, std::size_t execute = 0)
      : client_(client), ahead_(ahead), execute_(execute) {
    if (execute != 0 && ahead >= execute)
      throw Error("invalid_input", "ahead: expected less than execute, got " + std::to_string(ahead));
    thread_ = std::thread([this] { work(); });
  }

  ChunkPlayer(const ChunkPlayer&) = delete;
  ChunkPlayer& operator=(const ChunkPlayer&) = delete;
  ~ChunkPlayer() { stop(); }

  /// Begin an episode; what is left of the last one is dropped.
  Json reset(const Observation& obs, const std::string& instruction, Json kwargs = Json::object()) {
    {
      std::unique_lock<std::mutex> lock(mutex_);
      changed_.wait(lock, [this] { return !asking_; });
      answer_.reset();
      failure_ = nullptr;
      chunk_.reset();
      ticks_ = reported_ = {};
      executed_age_ms_.reset();
    }
    return client_.reset(obs, instruction, std::move(kwargs));
  }

  /// The action of this tick. Waits if the next chunk is not there.
  /// @throws Error what asking for the next chunk threw, once the rows of this one are executed
  Command act(const Observation& obs) { return *next(obs, true); }

  /// The action of this tick, without waiting; none if the next chunk is not there: hold the robot.
  std::optional<Command> try_act(const Observation& obs) { return next(obs, false); }

  /// Count ticks that passed while your loop was busy, such as with waiting in `act`: no action came in time for them.
  void count_missed(std::size_t missed) {
    const std::lock_guard<std::mutex> guard(mutex_);
    ticks_.all += missed;
    ticks_.starved += missed;
  }

  /// The ticks of the episode so far: the calls of `act` and `try_act`, and those of `count_missed`.
  Ticks ticks() {
    const std::lock_guard<std::mutex> guard(mutex_);
    return ticks_;
  }

 private:
  using Clock = std::chrono::steady_clock;

  std::optional<Command> next(const Observation& obs, bool wait) {
    std::unique_lock<std::mutex> lock(mutex_);
    while (left() == 0) {
      if (answer_) {
        take();  // there may be none left: all of its rows came too late
      } else if (failure_) {
        count_starved();
        std::rethrow_exception(std::exchange(failure_, nullptr));
      } else {
        if (!asking_) ask(obs);
        if (!wait) {
          count_starved();
          return std::nullopt;
        }
        changed_.wait(lock, [this] { return !asking_; });
      }
    }
    if (left() <= ahead_ && !asking_ && !answer_ && !failure_) ask(obs);
    Command command;
    command.action = chunk_->row(at_);
    command.row = at_++;
    command.done = chunk_->done && left() == 0;
    ++executed_;
    ++ticks_.all;
    executed_age_ms_ = std::chrono::duration<double, std::milli>(Clock::now() - seen_at_).count();
    return command;
  }

  void count_starved() {
    ++ticks_.all;
    ++ticks_.starved;
  }

  /// Rows of the chunk that are still to be executed.
  std::size_t left() const { return chunk_ ? end_ - at_ : 0; }

  void ask(const Observation& obs) {
    asked_ = obs;
    asked_at_ = Clock::now();
    asked_.info["ticks"] = {ticks_.all - reported_.all, ticks_.starved - reported_.starved};
    reported_ = ticks_;
    if (executed_age_ms_) asked_.info["executed_age_ms"] = *executed_age_ms_;
    executed_age_ms_.reset();
    asking_ = true;
    executed_ = 0;
    changed_.notify_all();
  }

  /// Go on with the chunk that came.
  void take() {
    chunk_ = std::exchange(answer_, std::nullopt);
    seen_at_ = asked_at_;
    end_ = execute_ == 0 ? chunk_->rows : std::min(execute_, chunk_->rows);
    at_ = std::min(executed_, end_);
  }

  void work() noexcept {
    std::unique_lock<std::mutex> lock(mutex_);
    while (true) {
      changed_.wait(lock, [this] { return asking_ || stopping_; });
      if (stopping_) return;
      const Observation obs = std::move(asked_);
      lock.unlock();
      std::optional<Act> found;
      std::exception_ptr failed;
      try {
        found = client_.act(obs);
      } catch (...) {
        failed = std::current_exception();  // thrown by the `act` that finds no row left
      }
      lock.lock();
      answer_ = std::move(found);
      failure_ = failed;
      asking_ = false;
      changed_.notify_all();
    }
  }

  void stop() noexcept {
    {
      const std::lock_guard<std::mutex> guard(mutex_);
      stopping_ = true;
      changed_.notify_all();
    }
    thread_.join();
  }

  Client& client_;
  const std::size_t ahead_;
  const std::size_t execute_;
  std::mutex mutex_;
  std::condition_variable changed_;
  Observation asked_;
  bool asking_ = false;
  bool stopping_ = false;
  std::optional<Act> answer_;
  std::exception_ptr failure_;
  std::optional<Act> chunk_;
  std::size_t at_ = 0;        // the next row of the chunk
  std::size_t end_ = 0;       // the row after the last one that is executed
  std::size_t executed_ = 0;  // rows executed since the next chunk was asked for
  Ticks ticks_;               // of this episode
  Ticks reported_;            // those of `ticks_` that earlier requests have reported
  Clock::time_point asked_at_, seen_at_;  // when the last observation was asked with, and that of the chunk
  std::optional<double> executed_age_ms_;  // of the last action since the last request
  std::thread thread_;
};

}  // namespace vlagents_ray

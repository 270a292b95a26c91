// A boat on the bus: the vehicle's side in C++ with stock LCM, and nothing of ours but
// the message types. What is simulated here is what you replace: sense() and actuate().
//
//     boat URL NAME DURATION
//
// A vehicle sends what it measured, checks what it is told, applies that within its own
// limits, reports the integral of what it applied, and does something safe by itself
// when commands fail to come.
#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>

#include <lcm/lcm-cpp.hpp>

#include "vcbf_lcm/vcbf_command.hpp"
#include "vcbf_lcm/vcbf_state.hpp"

namespace {

constexpr double kPeriod = 0.02;              // Between states [s].
constexpr double kMass = 12.0, kDrag = 4.0;   // [kg], [kg/m]
constexpr double kLimit = 4.0;                // Of each pair of thrusters [N].
constexpr int64_t kTimeout = 100'000;         // Without commands [us].

// Microseconds since 1970, never set back: the system's clock as it was at the start.
int64_t Now() {
  using std::chrono::microseconds, std::chrono::duration_cast;
  static const auto start = std::chrono::steady_clock::now();
  static const int64_t began = duration_cast<microseconds>(
      std::chrono::system_clock::now().time_since_epoch()).count();
  return began + duration_cast<microseconds>(
      std::chrono::steady_clock::now() - start).count();
}

struct Boat {
  std::array<double, 4> state{};     // x, y [m], vx, vy [m/s]
  std::array<double, 2> thrust{};    // What is applied now [N].
  std::array<double, 2> integral{};  // Of what was applied [N s].
  double time = 0.0;                 // Of the motion [s].

  // Quadratic drag, gusts and a current: yours is the water.
  void Move(double dt) {
    const double gusts[2] = {0.03 * std::sin(0.9 * time) - 0.03,
                             0.06 * std::sin(0.9 * time) + 0.03};
    const double speed = std::hypot(state[2], state[3]);
    for (int i = 0; i < 2; ++i) {
      const double drag = kDrag * speed * state[2 + i];
      const double rate = (thrust[i] - drag) / kMass + gusts[i];
      state[i] += dt * state[2 + i] + 0.5 * dt * dt * rate;
      state[2 + i] += dt * rate;
      integral[i] += dt * thrust[i];
    }
    time += dt;
  }
};

class Vehicle {
 public:
  Vehicle(lcm::LCM* bus, const std::string& name)
      : bus_(bus), channel_("VCBF_STATE/" + name), session_(Now()) {
    bus_->subscribe("VCBF_COMMAND/" + name, &Vehicle::OnCommand, this);
  }

  void Run(double duration) {
    int64_t last = Now(), next = last;
    while (boat_.time < duration) {
      next += static_cast<int64_t>(1e6 * kPeriod);
      // Commands act when they come, so the motion is cut there.
      for (int64_t now = Now(); now < next; now = Now()) {
        bus_->handleTimeout(std::max<int64_t>(1, (next - now) / 1000));
        Advance(&last);
      }
      Watch();
      Send(mode_);
    }
    // The end, again and again: of messages that come at once a bus may keep one.
    for (int i = 0; i < 10; ++i) {
      Send(3);
      std::this_thread::sleep_for(std::chrono::milliseconds(50));
    }
    std::printf("boat: %.2f m from the goal, %ld commands, %ld late, %ld rejected\n",
                std::hypot(boat_.state[0] - 9.0, boat_.state[1] - 1.0), accepted_,
                late_, rejected_);
  }

 private:
  void Advance(int64_t* last) {
    const int64_t now = Now();
    if (mode_ != 0) boat_.Move(1e-6 * (now - *last));  // It stands until then.
    *last = now;
    if (mode_ == 0 && accepted_ > 0) mode_ = 1;
  }

  void OnCommand(const lcm::ReceiveBuffer*, const std::string&,
                 const vcbf_lcm::vcbf_command* command) {
    const int64_t now = Now();
    const bool is_silent = now - received_at_ > kTimeout;
    if (now - command->state_utime >= 500'000) {  // Of a state long gone.
      ++late_;
      return;
    }
    // Its format; that it answers us; that it comes from the controller we follow; that
    // it goes forward. Stock LCM has checked the type, and that no byte is missing.
    bool good = command->version == 2 && command->num_inputs == 2 &&
                command->state_session == session_ && command->mode >= 0 &&
                command->mode <= 3;
    if (good && command->session != followed_) {
      good = is_silent || command_mode_ == 3 ||
             (command->takes_over && command->session > followed_);
    } else if (good) {
      good = command->sequence > sequence_;
    }
    for (double u : command->input) good = good && std::isfinite(u);
    if (!good) {
      ++rejected_;
      return;
    }
    ++accepted_;
    followed_ = command->session, sequence_ = command->sequence;
    command_utime_ = command->utime, command_mode_ = command->mode;
    received_at_ = now;
    const bool applies = command->mode <= 1;
    if (mode_ != 0) mode_ = applies ? 1 : 2;
    for (int i = 0; i < 2; ++i) {
      boat_.thrust[i] =
          applies ? std::clamp(command->input[i], -kLimit, kLimit) : Brake(i);
    }
  }

  // The watchdog: without commands it brakes by itself.
  void Watch() {
    const bool is_alone = mode_ != 0 && Now() - received_at_ > kTimeout;
    if (is_alone) mode_ = 2;
    for (int i = 0; i < 2 && mode_ == 2; ++i) boat_.thrust[i] = Brake(i);
  }

  double Brake(int i) const {
    return std::clamp(-2.0 * kMass * boat_.state[2 + i], -kLimit, kLimit);
  }

  void Send(int8_t mode) {
    vcbf_lcm::vcbf_state message{};
    message.version = 2;
    message.session = session_;
    message.sequence = sent_++;
    message.utime = message.utime_measured = Now();
    message.time = boat_.time;
    message.mode = mode;
    message.command_session = accepted_ ? followed_ : -1;
    message.command_sequence = accepted_ ? sequence_ : -1;
    message.command_utime = command_utime_;
    message.command_age = accepted_ ? message.utime - received_at_ : 0;
    message.num_states = 4, message.num_inputs = 2;
    message.state.assign(boat_.state.begin(), boat_.state.end());
    message.input_integral.assign(boat_.integral.begin(), boat_.integral.end());
    bus_->publish(channel_, &message);
  }

  lcm::LCM* bus_;
  std::string channel_;
  int64_t session_;
  Boat boat_;
  int8_t mode_ = 0, command_mode_ = 3;
  int64_t followed_ = -1, sequence_ = -1, command_utime_ = 0, received_at_ = 0;
  int64_t sent_ = 0;
  long accepted_ = 0, late_ = 0, rejected_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  if (argc != 4) return std::fprintf(stderr, "boat URL NAME DURATION\n"), 2;
  lcm::LCM bus(argv[1]);
  if (!bus.good()) return std::fprintf(stderr, "boat: no bus at %s\n", argv[1]), 1;
  Vehicle(&bus, argv[2]).Run(std::atof(argv[3]));
}

// C++ wrapper of trabecula.h: RAII for connections and loans, errors as exceptions. Header only; needs C++17.
//
// Messages are the structs of trabecula.h. A Client belongs to the thread that created it. Returned
// references and pointers are in shared memory; each function documents how long they are valid.
#ifndef TRABECULA_HPP
#define TRABECULA_HPP

#include <cmath>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>

#include "trabecula.h"

namespace trabecula {

// A failed library call; what() states the given value, what is expected, and what to do.
class Error : public std::runtime_error {
public:
    explicit Error(int status)
        : std::runtime_error(status == TRB_TIMEOUT ? "timed out" : trb_last_error()),
          status_(status) {}
    // One of the TRB_ statuses; TRB_TIMEOUT on a timeout, TRB_ENDED if the run is over.
    int status() const noexcept { return status_; }

private:
    int status_;
};

inline void check(int status) {
    if (status != TRB_OK) throw Error(status);
}

// Returns true for TRB_OK and false for TRB_TIMEOUT; throws otherwise.
inline bool came(int status) {
    if (status == TRB_TIMEOUT) return false;
    check(status);
    return true;
}

// A command to fill in. send() sends its current content; without send(), the destructor discards it. Using
// it after send() throws std::logic_error.
class Loan {
public:
    explicit Loan(trb_client client) : client_(client) { check(trb_loan_command(client, &command_)); }
    Loan(Loan &&other) noexcept : client_(other.client_), command_(std::exchange(other.command_, nullptr)) {}
    Loan(const Loan &) = delete;
    Loan &operator=(const Loan &) = delete;
    Loan &operator=(Loan &&) = delete;
    ~Loan() {
        if (command_) trb_discard_command(client_);
    }
    trb_command *operator->() { return unsent(); }
    trb_command &operator*() { return *unsent(); }
    void send() {
        unsent();
        check(trb_send_command(client_));
        command_ = nullptr;
    }

private:
    trb_command *unsent() const {
        if (!command_)
            throw std::logic_error("the command has been sent; get the next one from Client::command()");
        return command_;
    }
    trb_client client_;
    trb_command *command_ = nullptr;
};

// A connection to a session.
class Client {
public:
    // session: folder or name; null uses TRABECULA_SESSION, or else this user's only running session.
    // controller: name in the scene, "" for an observer; null uses TRABECULA_CONTROLLER, or else the scene's
    // only external controller.
    explicit Client(const char *session = nullptr, const char *controller = nullptr, double timeout_s = 10.0) {
        check(trb_connect(TRB_LAYOUTS, session, controller, timeout_s, &client_));
    }
    Client(Client &&other) noexcept : client_(std::exchange(other.client_, 0)) {}
    Client &operator=(Client &&other) noexcept {
        std::swap(client_, other.client_);
        return *this;
    }
    Client(const Client &) = delete;
    Client &operator=(const Client &) = delete;
    ~Client() {
        if (client_) trb_disconnect(client_);
    }

    // For calls of the C interface that this class lacks.
    trb_client handle() const noexcept { return client_; }

    // Constant properties of the session; the texts live as long as this object.
    trb_session_info info() const {
        trb_session_info info;
        check(trb_get_info(client_, &info));
        return info;
    }

    // Waits for the newest state; null when the run is over. Valid until the next state is taken. A paused
    // run publishes none: without a limit this keeps waiting.
    const trb_state *wait_state(double timeout_s = INFINITY) {
        return state(trb_wait_state(client_, timeout_s, &state_));
    }
    // Waits for the oldest state not yet taken; null when the run is over.
    const trb_state *next_state(double timeout_s = INFINITY) {
        return state(trb_next_state(client_, timeout_s, &state_));
    }
    // Returns the newest state if one has arrived, else null. Throws Error with TRB_ENDED when the run is
    // over.
    const trb_state *poll_state() { return came(trb_poll_state(client_, &state_)) ? state_ : nullptr; }
    std::uint64_t states_missed() const {
        std::uint64_t count;
        check(trb_states_missed(client_, &count));
        return count;
    }

    // Returns the command that answers the last state taken.
    Loan command() { return Loan(client_); }

    // Requests a frame of the state at `tick`, from a pose of the C-arm or the scene's; returns the request's
    // id.
    std::uint64_t request_frame(std::uint64_t tick = 0, const trb_pose *t_world_c_arm = nullptr) {
        std::uint64_t request;
        check(trb_request_frame(client_, t_world_c_arm, tick, &request));
        return request;
    }
    // Waits for the frame of a request, or for the next one if `request` is 0. Valid until the next one is
    // returned.
    trb_frame_view wait_frame(std::uint64_t request, double timeout_s) {
        trb_frame_view view;
        check(trb_wait_frame(client_, request, timeout_s, &view));
        return view;
    }
    // Returns the CT volume in place; valid as long as this object.
    trb_volume_view volume(double timeout_s = 10.0) {
        trb_volume_view view;
        check(trb_get_volume(client_, timeout_s, &view));
        return view;
    }

    // Sends one of the TRB_CONTROL_ actions; `ticks` applies to TRB_CONTROL_STEP.
    trb_run_control_reply run_control(std::uint32_t action, std::uint64_t ticks = 0, double timeout_s = 10.0) {
        trb_run_control_reply reply;
        check(trb_control_run(client_, action, ticks, timeout_s, &reply));
        return reply;
    }
    // Returns the newest status of the run, if one has arrived.
    std::optional<trb_run_status> status() {
        trb_run_status status;
        return came(trb_get_status(client_, &status)) ? std::optional(status) : std::nullopt;
    }
    // Returns the oldest event not yet taken; valid until the next one is returned.
    std::optional<trb_event_view> next_event() {
        trb_event_view view;
        return came(trb_next_event(client_, &view)) ? std::optional(view) : std::nullopt;
    }
    // Returns the oldest message about removed voxels not yet taken; valid until the next one is returned.
    std::optional<trb_removed_view> next_removed() {
        trb_removed_view view;
        return came(trb_next_removed(client_, &view)) ? std::optional(view) : std::nullopt;
    }
    // Returns the oldest reading of any sensor not yet taken; readings that arrive with a state are available
    // when the state is. Valid until the next one is returned.
    const trb_sensor_reading *next_reading() {
        const trb_sensor_reading *reading = nullptr;
        return came(trb_next_reading(client_, &reading)) ? reading : nullptr;
    }
    // Returns the newest Jacobian of the tip, or null if the scene does not set `manipulator.tip_jacobian`;
    // that of a state is available when the state is. Valid until the next call.
    const trb_tip_jacobian *tip_jacobian() {
        const trb_tip_jacobian *jacobian = nullptr;
        return came(trb_newest_tip_jacobian(client_, &jacobian)) ? jacobian : nullptr;
    }
    // Adds a text to the session's events, which are recorded in the log.
    void remark(const std::string &text, std::uint32_t severity = TRB_SEVERITY_INFO) {
        check(trb_remark(client_, severity, text.c_str()));
    }

private:
    const trb_state *state(int status) {
        if (status == TRB_ENDED) return nullptr;
        check(status);
        return state_;
    }

    trb_client client_ = 0;
    const trb_state *state_ = nullptr;
};

}  // namespace trabecula

#endif

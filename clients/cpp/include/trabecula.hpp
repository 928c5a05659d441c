// C++ wrapper of trabecula.h: connections, loans and errors with C++'s lifetimes. Header only; needs C++17.
//
// Messages are the structs of trabecula.h. A Client belongs to the thread that made it. References and
// pointers that it hands out lie in shared memory; each function says until when.
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

// What a call of the library refused; what() says what was given, what was expected, what to do.
class Error : public std::runtime_error {
public:
    explicit Error(int status)
        : std::runtime_error(status == TRB_TIMEOUT ? "nothing came in time" : trb_last_error()),
          status_(status) {}
    // One of the TRB_ statuses; TRB_TIMEOUT if nothing came in time, TRB_ENDED if the run is over.
    int status() const noexcept { return status_; }

private:
    int status_;
};

inline void check(int status) {
    if (status != TRB_OK) throw Error(status);
}

// Passes TRB_OK on as true, TRB_TIMEOUT as false.
inline bool came(int status) {
    if (status == TRB_TIMEOUT) return false;
    check(status);
    return true;
}

// A command to be filled in. Sent by send(), as it is then; forgotten unsent if that was not called. To use
// it behind send() is a std::logic_error.
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
        if (!command_) throw std::logic_error("the command has been sent; Client::command() gives the next one");
        return command_;
    }
    trb_client client_;
    trb_command *command_ = nullptr;
};

// A connection to a session.
class Client {
public:
    // session: folder or name; null takes TRABECULA_SESSION or the newest. controller: name in the scene, ""
    // for an observer; null takes TRABECULA_CONTROLLER or the scene's only external controller.
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

    // For calls of the C interface that this class has not.
    trb_client handle() const noexcept { return client_; }

    // Facts of the session; the texts live as long as this object.
    trb_session_info info() const {
        trb_session_info info;
        check(trb_get_info(client_, &info));
        return info;
    }

    // The newest state; null when the run is over. Stays until the next state is taken. A paused run
    // publishes none: without a limit this waits on.
    const trb_state *wait_state(double timeout_s = INFINITY) { return state(trb_wait_state(client_, timeout_s, &state_)); }
    // The oldest state that has not been taken; null when the run is over.
    const trb_state *next_state(double timeout_s = INFINITY) { return state(trb_next_state(client_, timeout_s, &state_)); }
    // The newest state if one has come; null if not. Throws Error with TRB_ENDED when the run is over.
    const trb_state *poll_state() { return came(trb_poll_state(client_, &state_)) ? state_ : nullptr; }
    std::uint64_t states_missed() const {
        std::uint64_t count;
        check(trb_states_missed(client_, &count));
        return count;
    }

    // The command that answers the state taken last.
    Loan command() { return Loan(client_); }

    // Asks for a frame of the state of `tick`, from a pose of the C-arm or as it stands; returns the
    // request's number.
    std::uint64_t request_frame(std::uint64_t tick = 0, const trb_pose *t_world_c_arm = nullptr) {
        std::uint64_t request;
        check(trb_request_frame(client_, t_world_c_arm, tick, &request));
        return request;
    }
    // The frame of a request, or with 0 the next one. Stays until the next one is returned.
    trb_frame_view wait_frame(std::uint64_t request, double timeout_s) {
        trb_frame_view view;
        check(trb_wait_frame(client_, request, timeout_s, &view));
        return view;
    }
    // The CT volume in place; stays as long as this object.
    trb_volume_view volume(double timeout_s = 10.0) {
        trb_volume_view view;
        check(trb_get_volume(client_, timeout_s, &view));
        return view;
    }

    // One of the TRB_CONTROL_ actions; `ticks` is for TRB_CONTROL_STEP.
    trb_run_control_reply run_control(std::uint32_t action, std::uint64_t ticks = 0, double timeout_s = 10.0) {
        trb_run_control_reply reply;
        check(trb_control_run(client_, action, ticks, timeout_s, &reply));
        return reply;
    }
    // Where the run stands, if that is known.
    std::optional<trb_run_status> status() {
        trb_run_status status;
        return came(trb_get_status(client_, &status)) ? std::optional(status) : std::nullopt;
    }
    // The oldest event that has not been taken; stays until the next one is
    // returned.
    std::optional<trb_event_view> next_event() {
        trb_event_view view;
        return came(trb_next_event(client_, &view)) ? std::optional(view) : std::nullopt;
    }
    // The oldest message about removed voxels that has not been taken; stays until the next
    // one is returned.
    std::optional<trb_removed_view> next_removed() {
        trb_removed_view view;
        return came(trb_next_removed(client_, &view)) ? std::optional(view) : std::nullopt;
    }
    // The oldest reading of any sensor that has not been taken; those that arrive with a
    // state are there when the state is. Stays until the next one is returned.
    const trb_sensor_reading *next_reading() {
        const trb_sensor_reading *reading = nullptr;
        return came(trb_next_reading(client_, &reading)) ? reading : nullptr;
    }
    // Writes a line to the session's events, and so into the log.
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

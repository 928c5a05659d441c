//! Shared by the Zig examples: an error ends the program with its text.

pub const c = @cImport({
    @cInclude("stdio.h");
    @cInclude("trabecula.h");
});

const std = @import("std");

/// True for TRB_OK, false for TRB_ENDED; anything else ends the program.
pub fn checked(status: i32) bool {
    if (status == c.TRB_OK) return true;
    if (status == c.TRB_ENDED) return false;
    const text: [*:0]const u8 = if (status < 0) c.trb_last_error() else "timed out";
    std.debug.print("error {d}: {s}\n", .{ status, text });
    std.process.exit(1);
}

/// Connects to the session, and as the controller, given by the environment or by the only running session.
pub fn connected() c.trb_client {
    var client: c.trb_client = 0;
    _ = checked(c.trb_connect(c.TRB_LAYOUTS, null, null, 10.0, &client));
    return client;
}

/// Waits for the newest state; null when the run is over. A paused run publishes none, so this keeps waiting.
pub fn nextState(client: c.trb_client) ?*const c.trb_state {
    var state: [*c]const c.trb_state = null;
    return if (checked(c.trb_wait_state(client, std.math.inf(f64), &state))) state else null;
}

/// Sends a tension on tendon 0.
pub fn sendTension(client: c.trb_client, tension_n: f64) void {
    var command: [*c]c.trb_command = null;
    _ = checked(c.trb_loan_command(client, &command));
    command.*.tendon_mode = c.TRB_TENDON_SERVO_JF;
    command.*.tendon_force_n[0] = tension_n;
    _ = checked(c.trb_send_command(client));
}

//! Holds 5 N on tendon 0 and prints the tip position.

const example = @import("example.zig");
const c = example.c;

pub fn main() void {
    const client = example.connected();
    while (example.nextState(client)) |state| {
        if (state.tick % 200 == 0) {
            const tip_m = state.t_world_tip.position_m;
            _ = c.printf("tick %4llu  tip %8.3f %8.3f %8.3f mm\n", state.tick, tip_m[0] * 1e3, tip_m[1] * 1e3, tip_m[2] * 1e3);
        }
        example.sendTension(client, 5.0);
    }
    _ = example.checked(c.trb_disconnect(client));
    _ = c.fflush(null);
}

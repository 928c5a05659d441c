// Holds 5 N on tendon 0 and prints the tip position.
#include <cinttypes>
#include <cstdio>

#include "trabecula.hpp"

int main() try {
    trabecula::Client client;
    while (const trb_state *state = client.wait_state()) {
        if (state->tick % 200 == 0) {
            const double *tip_m = state->t_world_tip.position_m;
            std::printf("tick %4" PRIu64 "  tip %8.3f %8.3f %8.3f mm\n", state->tick, tip_m[0] * 1e3,
                        tip_m[1] * 1e3, tip_m[2] * 1e3);
        }
        auto command = client.command();
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = 5.0;
        command.send();
    }
} catch (const trabecula::Error &error) {
    std::fprintf(stderr, "error %d: %s\n", error.status(), error.what());
    return 1;
}

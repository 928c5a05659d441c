/* Holds 5 N on tendon 0 and prints the tip position. */
#include "example.h"

int main(void) {
    trb_client client = connected();
    const trb_state *state;
    while (checked(trb_wait_state(client, INFINITY, &state)) == TRB_OK) {
        if (state->tick % 200 == 0) {
            const double *tip_m = state->t_world_tip.position_m;
            printf("tick %4" PRIu64 "  tip %8.3f %8.3f %8.3f mm\n", state->tick, tip_m[0] * 1e3,
                   tip_m[1] * 1e3, tip_m[2] * 1e3);
        }
        trb_command *command;
        checked(trb_loan_command(client, &command));
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = 5.0;
        checked(trb_send_command(client));
    }
    checked(trb_disconnect(client));
    return 0;
}

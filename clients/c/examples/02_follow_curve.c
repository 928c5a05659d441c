/* Bends the manipulator along a curve over time: a PI controller sets the tendon tension.
 *
 * All languages use the same operations in the same order, so that a lockstep run ends with the same hash.
 * Compile with -ffp-contract=off: a fused multiply-add rounds once, separate operations twice. */
#include "example.h"

static const double PROPORTIONAL_N_PER_RAD = 6.0;
static const double INTEGRAL_N_PER_RAD_S = 40.0;
static const double TICK_S = 0.001;
static const double LARGEST_TENSION_N = 20.0;

/* 0 to 0.6 rad within 0.5 s and back to 0.3 rad within the next 0.5 s. */
static double planned_bend_rad(double time_s) {
    return time_s < 0.5 ? 1.2 * time_s : 0.6 - 0.6 * (time_s - 0.5);
}

int main(void) {
    trb_client client = connected();
    const trb_state *state;
    double integral_rad_s = 0.0;
    while (checked(trb_wait_state(client, INFINITY, &state)) == TRB_OK) {
        double error_rad = planned_bend_rad(state->sim_time_s) - state->bend_rad;
        integral_rad_s += error_rad * TICK_S;
        double tension_n = PROPORTIONAL_N_PER_RAD * error_rad + INTEGRAL_N_PER_RAD_S * integral_rad_s;
        if (tension_n < 0.0) {
            tension_n = 0.0;
        }
        if (tension_n > LARGEST_TENSION_N) {
            tension_n = LARGEST_TENSION_N;
        }
        if (state->tick % 200 == 0) {
            printf("tick %4" PRIu64 "  bend %7.4f rad  tension %7.4f N  hash %016" PRIx64 "%016" PRIx64 "\n",
                   state->tick, state->bend_rad, tension_n, state->hash[1], state->hash[0]);
        }
        trb_command *command;
        checked(trb_loan_command(client, &command));
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = tension_n;
        checked(trb_send_command(client));
    }
    checked(trb_disconnect(client));
    return 0;
}

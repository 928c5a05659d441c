/* Answers states: `echo spin|event ROUNDS`. `trabecula-lab bench latency` measures the other side. */
#include <string.h>

#include "../examples/example.h"

int main(int argc, char **argv) {
    if (argc != 3) {
        fprintf(stderr, "usage: echo spin|event ROUNDS\n");
        return 2;
    }
    int spin = strcmp(argv[1], "spin") == 0;
    trb_client client = connected();
    const trb_state *state;
    for (long left = atol(argv[2]); left > 0; left--) {
        int status;
        do {
            status = spin ? trb_poll_state(client, &state) : trb_wait_state(client, 30.0, &state);
        } while (status == TRB_TIMEOUT);
        if (checked(status) == TRB_ENDED) {
            return 1;
        }
        trb_command *command;
        checked(trb_loan_command(client, &command));
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = state->bend_rad;
        checked(trb_send_command(client));
    }
    checked(trb_disconnect(client));
    return 0;
}

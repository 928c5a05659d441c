/* A command keeps its content once sent: each requests 3 N, and 55 N are written repeatedly through its
 * pointer until the next state arrives. Run by the test tests/processes/sent.rs. */
#include "../examples/example.h"

int main(void) {
    trb_client client = connected();
    const trb_state *state;
    while (checked(trb_wait_state(client, INFINITY, &state)) == TRB_OK) {
        trb_command *command;
        checked(trb_loan_command(client, &command));
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = 3.0;
        checked(trb_send_command(client));
        int status = TRB_TIMEOUT;
        while (status == TRB_TIMEOUT) {
            command->tendon_force_n[0] = 55.0;
            status = trb_poll_state(client, &state);
        }
        if (checked(status) == TRB_ENDED) {
            break;
        }
        /* The next command contains nothing written before it was loaned. */
        command->tendon_force_n[1] = 55.0;
        checked(trb_loan_command(client, &command));
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = 3.0;
        checked(trb_send_command(client));
        command->tendon_force_n[0] = 55.0;
    }
    checked(trb_disconnect(client));
    puts("ended");
    return 0;
}

/* A call from a signal handler in the middle of a wait is refused, and the wait continues. Run by a test in
 * tests/processes/forks.rs as the controller of a lockstep run. */
#include <signal.h>
#include <sys/time.h>

#include "../examples/example.h"

static trb_client client;
static volatile sig_atomic_t refused, others;

static void handler(int signal) {
    (void)signal;
    uint64_t count;
    int status = trb_states_missed(client, &count);
    if (status == TRB_ERROR_BUSY) {
        refused = refused + 1;
    } else if (status != TRB_OK) {
        others = others + 1;
    }
}

int main(void) {
    client = connected();
    const trb_state *state;
    checked(trb_wait_state(client, 60.0, &state));
    signal(SIGALRM, handler);
    struct itimerval every_ms = {{0, 1000}, {0, 1000}}, never = {{0, 0}, {0, 0}};
    setitimer(ITIMER_REAL, &every_ms, NULL);
    /* No new state arrives before the first one has been answered. */
    for (int i = 0; i < 200 && refused < 20; i++) {
        int status = trb_wait_state(client, 0.05, &state);
        if (status != TRB_TIMEOUT) {
            fprintf(stderr, "the wait ended with %d: %s\n", status, trb_last_error());
            return 1;
        }
    }
    setitimer(ITIMER_REAL, &never, NULL);
    if (refused < 20 || others > 0) {
        fprintf(stderr, "%d calls refused, %d calls with another error\n", (int)refused, (int)others);
        return 1;
    }
    do {
        trb_command *command;
        checked(trb_loan_command(client, &command));
        checked(trb_send_command(client));
    } while (checked(trb_wait_state(client, 60.0, &state)) == TRB_OK);
    checked(trb_disconnect(client));
    puts("ended");
    return 0;
}

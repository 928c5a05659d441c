/* A child of fork(): calls through its parent's client are refused, and its exit does not disconnect the
 * parent. Run by the
 * test tests/processes/forks.rs as the controller of a lockstep run. */
#include <sys/wait.h>
#include <unistd.h>

#include "../examples/example.h"

static void answer(trb_client client) {
    const trb_state *state;
    checked(trb_wait_state(client, 60.0, &state));
    trb_command *command;
    checked(trb_loan_command(client, &command));
    command->tendon_mode = TRB_TENDON_SERVO_JF;
    command->tendon_force_n[0] = 2.0;
    checked(trb_send_command(client));
}

/* Returns 0 if every call of a child is refused. */
static int refusals(trb_client client) {
    const trb_state *state;
    trb_command *command;
    trb_session_info info;
    trb_run_status status;
    trb_event_view event;
    uint64_t count;
    int statuses[] = {
        trb_wait_state(client, 1.0, &state),      trb_poll_state(client, &state),
        trb_next_state(client, 1.0, &state),      trb_loan_command(client, &command),
        trb_send_command(client),                 trb_discard_command(client),
        trb_get_info(client, &info),              trb_get_status(client, &status),
        trb_states_missed(client, &count),        trb_next_event(client, &event),
        trb_remark(client, 0, "from the child"),  trb_control_run(client, TRB_CONTROL_STOP, 0, 1.0, NULL),
        trb_hold_memory(client),                  trb_disconnect(client),
    };
    for (size_t i = 0; i < sizeof statuses / sizeof *statuses; i++) {
        if (statuses[i] != TRB_ERROR_FORKED) {
            fprintf(stderr, "call %zu in the child: status %d\n", i, statuses[i]);
            return 1;
        }
    }
    return 0;
}

int main(void) {
    trb_client client = connected();
    answer(client);
    /* A normal exit with and without calls, and _exit. */
    for (int way = 0; way < 3; way++) {
        fflush(NULL);
        pid_t child = fork();
        if (child == 0) {
            int code = way == 0 ? 0 : refusals(client);
            if (way == 2) {
                _exit(code);
            }
            exit(code);
        }
        int status;
        waitpid(child, &status, 0);
        if (status != 0) {
            fprintf(stderr, "child %d: status %d\n", way, status);
            return 1;
        }
        answer(client);
    }
    const trb_state *state;
    while (checked(trb_wait_state(client, 60.0, &state)) == TRB_OK) {
        trb_command *command;
        checked(trb_loan_command(client, &command));
        checked(trb_send_command(client));
    }
    checked(trb_disconnect(client));
    puts("ended");
    return 0;
}

/* Shared by the C examples: an error ends the program with its text. */
#ifndef EXAMPLE_H
#define EXAMPLE_H

/* A paused run publishes nothing, so the examples wait for a state without limit: INFINITY. */
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "trabecula.h"

/* Returns TRB_OK and TRB_ENDED; anything else ends the program. */
static int checked(int status) {
    if (status != TRB_OK && status != TRB_ENDED) {
        fprintf(stderr, "error %d: %s\n", status, status < 0 ? trb_last_error() : "timed out");
        exit(1);
    }
    return status;
}

/* Connects to the session, and as the controller, given by the environment or by the only running session. */
static trb_client connected(void) {
    trb_client client;
    checked(trb_connect(TRB_LAYOUTS, NULL, NULL, 10.0, &client));
    return client;
}

#endif

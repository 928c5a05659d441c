/* What the C examples share: an error ends the program with its text. */
#ifndef EXAMPLE_H
#define EXAMPLE_H

/* A paused run publishes nothing, so the examples wait for a state as long as it takes: INFINITY. */
#include <inttypes.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "trabecula.h"

/* Passes TRB_OK and TRB_ENDED on; anything else ends the program. */
static int checked(int status) {
    if (status != TRB_OK && status != TRB_ENDED) {
        fprintf(stderr, "error %d: %s\n", status, status < 0 ? trb_last_error() : "nothing came in time");
        exit(1);
    }
    return status;
}

/* Connects to the session and under the name that the environment or the only running session gives. */
static trb_client connected(void) {
    trb_client client;
    checked(trb_connect(TRB_LAYOUTS, NULL, NULL, 10.0, &client));
    return client;
}

#endif

/* A controller, or a part of the plant, as an FMU (FMI 3.0, co-simulation), with what its master calls: a gain
   or a spring with a damper, u = gain (goal - y) - damping dy/dt, and an oscillation w about the goal. For the
   tests, and for `trabecula-lab bench latency`. */

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

enum { OK = 0, ERROR = 3 };
enum { Y = 1, GOAL, GAIN, U, DAMPING, AMPLITUDE, RATE, W, COUNT };

typedef struct {
    double value[COUNT];
    /* The last y, whether there is one, and the oscillation's position and speed. */
    double last;
    bool has_last;
    double at, speed;
} Gain;

static bool is_output(uint32_t reference) {
    return reference == U || reference == W;
}

const char *fmi3GetVersion(void) {
    return "3.0";
}

void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources, bool visible,
                                  bool logging, bool events, bool early, const uint32_t *needed, size_t count,
                                  void *environment, void *log, void *update) {
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)needed, (void)count, (void)environment, (void)log, (void)update;
    Gain *gain = calloc(1, sizeof *gain);
    if (gain)
        gain->value[GAIN] = 1.0;
    return gain;
}

void fmi3FreeInstance(void *instance) {
    free(instance);
}

int fmi3EnterInitializationMode(void *instance, bool has_tolerance, double tolerance, double start,
                                bool has_stop, double stop) {
    (void)instance, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return OK;
}

int fmi3ExitInitializationMode(void *instance) {
    Gain *gain = instance;
    gain->speed = gain->value[AMPLITUDE] * gain->value[RATE];
    return OK;
}

int fmi3Terminate(void *instance) {
    (void)instance;
    return OK;
}

int fmi3SetFloat64(void *instance, const uint32_t *reference, size_t count, const double *value,
                   size_t values) {
    Gain *gain = instance;
    for (size_t i = 0; i < count; i++) {
        if (values != count || reference[i] < Y || reference[i] >= COUNT || is_output(reference[i]))
            return ERROR;
        gain->value[reference[i]] = value[i];
    }
    return OK;
}

int fmi3GetFloat64(void *instance, const uint32_t *reference, size_t count, double *value, size_t values) {
    const Gain *gain = instance;
    for (size_t i = 0; i < count; i++) {
        if (values != count || reference[i] < Y || reference[i] >= COUNT)
            return ERROR;
        value[i] = gain->value[reference[i]];
    }
    return OK;
}

int fmi3DoStep(void *instance, double at, double step, bool no_rollback, bool *event, bool *terminate,
               bool *early, double *last) {
    Gain *gain = instance;
    (void)no_rollback;
    *event = *terminate = *early = false;
    *last = at + step;
    const double *value = gain->value;
    double rate = gain->has_last ? (value[Y] - gain->last) / step : 0.0;
    gain->last = value[Y];
    gain->has_last = true;
    gain->value[U] = value[GAIN] * (value[GOAL] - value[Y]) - value[DAMPING] * rate;
    gain->speed -= value[RATE] * value[RATE] * gain->at * step;
    gain->at += gain->speed * step;
    gain->value[W] = value[GOAL] + gain->at;
    return OK;
}

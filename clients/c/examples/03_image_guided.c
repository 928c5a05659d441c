/* Requests an X-ray frame every 0.1 s, finds the tip in it, and steers the tip sideways to a target.
 *
 * The tip is the end of the tool's metal: the dark pixel farthest along the tool, refined to the mean of the
 * dark pixels of the last 3 mm. Projected back to the plane of the tool, it gives the sideways error, which
 * drives the tension. */
#include "example.h"

static const double FRAME_LIMIT_S = 30.0;
static const uint64_t TICKS_BETWEEN_FRAMES = 100;
/* Pixels darker than this show metal (full scale: 65535). */
static const uint16_t DARK = 8000;
/* Target of the burr: sideways offset from its start (world x). */
static const double TARGET_M = 0.006;
static const double GAIN_N_PER_M = 350.0;
static const double END_LENGTH_M = 0.003;

static double dot(const double *a, const double *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Finds column and row of the tool's end; returns 0 if there is no metal in the image. */
static int find_tip(const trb_frame_view *view, double *column, double *row) {
    const trb_c_arm_geometry *geometry = &view->frame->geometry;
    uint64_t columns = geometry->columns;
    /* +z of the burr in the image: last column of the rotation matrix, projected on rows and columns. */
    const double *q = view->frame->t_world_burr.orientation_xyzw;
    double x = q[0], y = q[1], z = q[2], w = q[3];
    double axis[3] = {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)};
    double right = dot(geometry->row_axis, axis), down = dot(geometry->column_axis, axis);
    double end = -1e9;
    for (uint64_t i = 0; i < view->pixel_count; i++) {
        double along = (double)(i % columns) * right + (double)(i / columns) * down;
        if (view->pixels[i] < DARK && along > end) {
            end = along;
        }
    }
    double first = end - END_LENGTH_M / geometry->pixel_pitch_m[0];
    double count = 0.0;
    *column = 0.0;
    *row = 0.0;
    for (uint64_t i = 0; i < view->pixel_count; i++) {
        double along = (double)(i % columns) * right + (double)(i / columns) * down;
        if (view->pixels[i] < DARK && along >= first) {
            count += 1.0;
            *column += (double)(i % columns);
            *row += (double)(i / columns);
        }
    }
    if (count == 0.0) {
        return 0;
    }
    *column /= count;
    *row /= count;
    return 1;
}

/* Returns the world x of a column, in the plane of the isocentre: the image is magnified by the ratio of
 * source-detector to source-isocentre distance, 1000 to 700 mm. */
static double sideways_m(const trb_frame_view *view, double column) {
    const trb_c_arm_geometry *geometry = &view->frame->geometry;
    return (column - 0.5 * ((double)geometry->columns - 1.0)) * geometry->pixel_pitch_m[0] * 0.7;
}

int main(void) {
    trb_client client = connected();
    trb_session_info info;
    checked(trb_get_info(client, &info));
    const trb_state *state;
    double tension_n = 0.0;
    while (checked(trb_wait_state(client, INFINITY, &state)) == TRB_OK) {
        if (state->tick % TICKS_BETWEEN_FRAMES == 0 && state->tick < info.tick_count) {
            uint64_t request;
            trb_frame_view view;
            double column, row;
            checked(trb_request_frame(client, NULL, state->tick, &request));
            if (checked(trb_wait_frame(client, request, FRAME_LIMIT_S, &view)) == TRB_ENDED) {
                break;
            }
            if (find_tip(&view, &column, &row)) {
                double error_m = TARGET_M - sideways_m(&view, column);
                tension_n += GAIN_N_PER_M * error_m;
                if (tension_n < 0.0) {
                    tension_n = 0.0;
                }
                printf("tick %4" PRIu64 "  tip at column %6.2f row %6.2f  error %6.3f mm  tension %6.3f N\n",
                       state->tick, column, row, error_m * 1e3, tension_n);
            }
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

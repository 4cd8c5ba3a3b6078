/* A long path of ramps between random turns, which is the same on every processor; tells every thousandth voltage. */
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include "slpi_inverse.h"

int main(void)
{
    static slpi_inverse_t inverse;
    const double low[SLPI_AXES] = LOW, high[SLPI_AXES] = HIGH;
    uint32_t seed = 1u;
    double at = 0.5, goal = 0.5, step = 0.0;
    int left = 0, refused = 0;
    slpi_inverse_init(&inverse, NULL);
    for (int k = 0; k < STEPS; k++) {
        slpi_real desired[SLPI_AXES], volts[SLPI_AXES];
        if (left == 0) {
            seed = seed * 1664525u + 1013904223u;
            goal = 0.05 + 0.9 * (double)(seed >> 8) / 16777216.0;
            seed = seed * 1664525u + 1013904223u;
            left = 20 + (int)((seed >> 16) % 400u);
            step = (goal - at) / left;
        }
        at += step;
        left--;
        for (int i = 0; i < SLPI_AXES; i++) {
            desired[i] = (slpi_real)(low[i] + (high[i] - low[i]) * at);
        }
        refused += slpi_inverse_step(&inverse, k ? (slpi_real)1e-4 : 0, desired, volts) != 0;
        if (k % 1000 == 999) {
            printf("%.17g\n", (double)volts[0]);
        }
    }
    return refused != 0;
}

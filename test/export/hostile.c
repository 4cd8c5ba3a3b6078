/* Hostile inputs: whatever comes in, the voltages are finite and within the limits; 0 if so. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>

#include "slpi_inverse.h"

static uint64_t state = 88172645463325252u;

static uint64_t random_bits(void)
{
    state ^= state << 13;
    state ^= state >> 7;
    state ^= state << 17;
    return state;
}

static double uniform(double low, double high)
{
    return low + (high - low) * (double)(random_bits() >> 11) / 9007199254740992.0;
}

static double hostile_time(void)
{
    switch (random_bits() % 16) {
    case 0: return 0.0;
    case 1: return -1e-4;
    case 2: return (double)NAN;
    case 3: return (double)INFINITY;
    case 4: return 5e-324;
    case 5: return 1e300;
    case 6: return 1e-38;
    case 7: return pow(10.0, uniform(-12.0, 12.0));
    case 8: return uniform(0.0, 1.0);
    default: return 1e-4;
    }
}

static double hostile_displacement(double low, double high)
{
    switch (random_bits() % 16) {
    case 0: return (double)NAN;
    case 1: return (double)INFINITY;
    case 2: return -(double)INFINITY;
    case 3: return 5e-324;
    case 4: return 1e30;
    case 5: return low;
    case 6: return high;
    default: return uniform(low - 0.19 * (high - low), high + 0.19 * (high - low));
    }
}

int main(void)
{
    static slpi_inverse_t inverse;
    const double lower[SLPI_AXES] = LOWER, upper[SLPI_AXES] = UPPER, low[SLPI_AXES] = LOW, high[SLPI_AXES] = HIGH;
    slpi_real last[SLPI_AXES];
    int seen[6] = {0, 0, 0, 0, 0, 0};
    slpi_inverse_init(&inverse, NULL);
    slpi_inverse_step(&inverse, 0, (slpi_real[SLPI_AXES]){0}, last);
    for (long k = 0; k < STEPS; k++) {
        slpi_real desired[SLPI_AXES], volts[SLPI_AXES];
        const slpi_real dt = (slpi_real)hostile_time();
        int code;
        for (int i = 0; i < SLPI_AXES; i++) {
            /* Only every second axis is wrong at a time, so that some steps are taken. */
            desired[i] = (slpi_real)((random_bits() & 1) ? uniform(low[i], high[i]) : hostile_displacement(low[i], high[i]));
        }
#ifdef SLPI_SURROUNDINGS
        if (random_bits() % 32 == 0) {
            const double values[] = {(double)NAN, (double)INFINITY, 1e300, -1e30, 5e-324, uniform(-1e3, 1e3), 0.0};
            slpi_inverse_set(&inverse, (int)(random_bits() % (SLPI_SURROUNDINGS + 2)) - 1,
                (slpi_real)(random_bits() % 8 ? uniform(0.0, 20.0) : values[random_bits() % 7]));
        }
#endif
        if (random_bits() % 64 == 0) {
            slpi_inverse_drive(&inverse, dt, desired, NULL);
            continue;
        }
        code = slpi_inverse_step(&inverse, dt, desired, volts);
        seen[code]++;
        for (int i = 0; i < SLPI_AXES; i++) {
            /* Of a limit that is no float, the nearest. */
            if (!(volts[i] >= (slpi_real)lower[i] && volts[i] <= (slpi_real)upper[i])) {
                printf("step %ld, axis %d: %g V\n", k, i, (double)volts[i]);
                return 1;
            }
        }
    }
    printf("%d %d %d %d %d %d\n", seen[0], seen[1], seen[2], seen[3], seen[4], seen[5]);
    return seen[0] == 0;
}

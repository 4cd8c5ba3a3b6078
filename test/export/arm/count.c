/* Instructions of a step: with `-icount shift=0` one instruction takes 1 ns of the virtual clock, 25 ticks a microsecond. */
#include <stdint.h>
#include <stdio.h>

#include "slpi_inverse.h"

#define SYSTICK_CONTROL (*(volatile uint32_t *)0xE000E010u)
#define SYSTICK_RELOAD (*(volatile uint32_t *)0xE000E014u)
#define SYSTICK_NOW (*(volatile uint32_t *)0xE000E018u)

static uint32_t ticks(void)
{
    return 0xFFFFFFu - SYSTICK_NOW;
}

int main(void)
{
    static slpi_inverse_t inverse;
    const double low[SLPI_AXES] = LOW, high[SLPI_AXES] = HIGH;
    uint32_t most = 0, started, all = 0;
    const int steps = 2000;
    SYSTICK_RELOAD = 0xFFFFFFu;
    SYSTICK_NOW = 0;
    SYSTICK_CONTROL = 5;
    slpi_inverse_init(&inverse, NULL);
    for (int k = 0; k < steps; k++) {
        slpi_real desired[SLPI_AXES], volts[SLPI_AXES];
        /* A triangle of 100 steps a leg. */
        const double at = k % 200 < 100 ? (k % 200) / 100.0 : 2.0 - (k % 200) / 100.0;
        for (int i = 0; i < SLPI_AXES; i++) {
            desired[i] = (slpi_real)(low[i] + (high[i] - low[i]) * (0.1 + 0.8 * at));
        }
        started = ticks();
        slpi_inverse_step(&inverse, (slpi_real)1e-4, desired, volts);
        started = (ticks() - started) & 0xFFFFFFu;
        all += started;
        most = started > most ? started : most;
    }
    printf("%.0f instructions a step, at most %.0f\n", all * 40.0 / steps, most * 40.0);
    return 0;
}

/* Main loop of a microcontroller: a timer says when a period has passed, and the loop reads a setpoint and sets the DAC.
 * To change: the four functions of the board, and PERIOD. Build with -DSLPI_FLOAT where the processor has no double. */
#include <stdint.h>

#include "slpi_inverse.h"

/* s, of the timer */
#define PERIOD ((slpi_real)1e-4)

/* Of the board. */
int board_period_passed(void);                    /* 1 once in each period; 2 or more: periods were missed */
void board_read_setpoint(slpi_real *desired);     /* m, SLPI_AXES of them */
void board_read_amplifier(slpi_real *volts);      /* V, what the DAC has now */
void board_write_dac(const slpi_real *volts);     /* V */
void board_report(int reason);                    /* why a setpoint was refused */
int board_runs(void);

/* All of the state: no heap, and a size that the linker knows. */
static slpi_inverse_t inverse;

void control(void)
{
    slpi_real desired[SLPI_AXES], volts[SLPI_AXES];
    slpi_real dt = (slpi_real)0;
    board_read_amplifier(volts);
    slpi_inverse_init(&inverse, volts);
    while (board_runs()) {
        const int passed = board_period_passed();
        int reason;
        if (passed == 0) {
            continue;
        }
        board_read_setpoint(desired);
        reason = slpi_inverse_step(&inverse, dt, desired, volts);
        /* Also of a setpoint that was refused: the voltages are the present ones. */
        board_write_dac(volts);
        if (reason != SLPI_OK) {
            board_report(reason);
        }
        dt = (slpi_real)passed * PERIOD;
    }
}

// A sine of each axis through the wrapper, as `update` of a controller would do at 10 kHz; prints the last voltages.
// Build with -DSTART_VOLTS=.. (V, where the amplifier is), -DMIDDLE=.. and -DSPAN=.. (m, of the stage's range).
#include <cmath>
#include <cstdio>
#include <type_traits>

#include "inverse.hpp"

static_assert(std::is_trivially_copyable<slpi_inverse_t>::value, "the state is saved by copying it");

int main() {
    stage::Values volts{};
    for (auto &each : volts) {
        each = static_cast<slpi_real>(START_VOLTS);
    }
    stage::Inverse inverse(volts);
    for (int k = 0; k < 10000; ++k) {
        stage::Values desired{};
        for (auto &each : desired) {
            each = static_cast<slpi_real>(MIDDLE + 0.3 * SPAN * std::sin(6.283185307179586 * 5.0 * k * 1e-4));
        }
        volts = inverse.update(k ? 1e-4 : 0.0, desired);
    }
    for (auto each : volts) {
        std::printf("%.9g V\n", static_cast<double>(each));
    }
    return inverse.refused() != 0;
}

// The exported inverse as a controller of ros2_control would hold it: plain C++17, nothing allocated after the start.
#pragma once

#include <array>
#include <cstddef>

#include "slpi_inverse.h"

namespace stage {

using Values = std::array<slpi_real, SLPI_AXES>;

class Inverse {
public:
    // on_activate: `now` are the voltages that the amplifier reports.
    explicit Inverse(const Values &now) : result_(slpi_inverse_init(&state_, now.data())), volts_(now) {}

    // update: `period` in seconds since the last update. The voltages are within the limits, whatever comes in.
    const Values &update(double period, const Values &desired) noexcept {
        result_ = slpi_inverse_step(&state_, static_cast<slpi_real>(period), desired.data(), volts_.data());
        refused_ += result_ != SLPI_OK;
        return volts_;
    }

    // Somebody else, such as a reset, has moved the stage to these voltages.
    void follow(double period, const Values &applied) noexcept {
        result_ = slpi_inverse_drive(&state_, static_cast<slpi_real>(period), applied.data(), nullptr);
    }

    int result() const noexcept { return result_; }
    std::size_t refused() const noexcept { return refused_; }

    // The whole state is one plain struct.
    slpi_inverse_t save() const noexcept { return state_; }
    void restore(const slpi_inverse_t &state) noexcept { state_ = state; }

private:
    slpi_inverse_t state_{};
    int result_ = SLPI_OK;
    Values volts_{};
    std::size_t refused_ = 0;
};

}  // namespace stage

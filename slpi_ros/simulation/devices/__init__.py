"""The protocols of real devices, with a simulated stage behind them."""

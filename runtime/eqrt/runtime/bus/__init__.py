"""Where messages come from and go to: CAN buses and recorded logs."""

"""The whole service: application, commands, checks of the machine."""

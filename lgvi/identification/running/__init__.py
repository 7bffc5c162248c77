"""How programs are compiled and run: devices, processes, and the bar that shows progress."""

"""Every system of the paper's tables behind one interface."""

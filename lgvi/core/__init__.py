"""The equations of rigid-body attitude: arrays in, arrays out, one state per call."""

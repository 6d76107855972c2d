"""Buildings, a sensor and visits whose truth is known; nothing in production imports it."""

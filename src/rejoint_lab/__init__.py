"""The lab: simulated reality (plant, emulators, cameras) and research; the product `rejoint` never imports it."""

"""The filter of a strapdown track: ``space``, rows as a navigation state sees them, and
``error_state``, which moves it and corrects it."""

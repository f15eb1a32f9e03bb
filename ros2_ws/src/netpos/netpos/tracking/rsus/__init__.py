"""The RSUs: ``register`` knows them, ``rsu`` brings their slow errors into the state of a track,
``learning`` learns these (``shift``, ``shares``), ``shared_errors`` for all devices."""

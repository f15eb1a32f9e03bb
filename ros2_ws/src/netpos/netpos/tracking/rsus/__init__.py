"""The RSUs: ``register`` knows them, ``rsu`` brings their slow errors into the state of a track,
``learning`` learns these (``shift``, ``nlos_rate``), ``shared_errors`` for all devices."""

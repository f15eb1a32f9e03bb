"""What a track estimates with: ``estimator`` is the interface, ``planar`` and ``spatial`` are the
two behind it.

``epoch_rows``   the measurements of an epoch as rows
``estimates``    mean, covariance and components of a planar device
``models``, ``strapdown_models``  from parameters to what the kernels take
``imu_buffer``, ``adaptive_process_noise``  the motion that the device itself reports
"""

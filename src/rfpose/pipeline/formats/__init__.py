"""What is kept between jobs: results, tracking runs, mounts, and the journals that let a stopped job go on."""

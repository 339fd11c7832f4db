"""Read and write messages over files and Zenoh, and run the loop that passes them through `core`."""

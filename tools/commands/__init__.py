"""The commands of `socast`, one file each."""

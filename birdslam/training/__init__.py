"""The shipped networks' schoolbook and teacher: targets, augmentation, networks, losses, export (extra [train])."""

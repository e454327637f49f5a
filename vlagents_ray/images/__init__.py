"""Images: JPEG and PNG files, MP4 videos, and the codecs that a message may use."""

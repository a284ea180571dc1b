"""Dense DAISY Filter Flow: superpixel labels, guided filter, winner takes all."""

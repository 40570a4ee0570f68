"""From one photo to many views, learned: latent diffusion over (object, domain, view), colour and depth at once.

Latents have the axes (object, domain, view, channel, height, width); domain 0 is colour, domain 1 depth.
"""

"""Optical flow: DAISY Filter Flow with interchangeable label searches (EMFOA by default), Lucas-Kanade and DIS."""
